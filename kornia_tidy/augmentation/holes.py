"""Holes of depth maps, filled from the nearest known pixel by jump flooding."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import pad

from kornia_tidy.checks import check_part


def fill_holes(depth: Tensor, valid: Tensor) -> Tensor:
    """Fill the holes of depth maps with the depth of the nearest valid pixel.

    Args:
        depth: metres, or any other values; those in holes are not read.
        valid: bool, True where the depth is known.

    Returns:
        The maps without holes, same type. Gradients reach the pixels that values were taken from.

    Shape:
        - depth and valid: (..., H, W), the same shape. Each (H, W) is filled by itself.

    Raises:
        TypeError: if ``valid`` is not a tensor of bool.
        ValueError: if the shapes differ, or a map has no valid pixel.

    Convention:
        - Distances are Euclidean, between the centres of pixels. Jump flooding finds the nearest pixel nearly always;
          else one that is farther by less than a pixel.
        - The time is that of about ten passes over the maps for each doubling of their side, on any device.

    Source: Rong and Tan: Jump flooding in GPU with applications to Voronoi diagram and distance transform, I3D 2006,
    with the two closing passes of Rong and Tan, ISVD 2007.

    Example:
        >>> depth = torch.tensor([[2.0, 0.0, 0.0, 5.0]])
        >>> fill_holes(depth, depth > 0)
        tensor([[2., 2., 5., 5.]])
    """
    for name, value in (("depth", depth), ("valid", valid)):
        check_part(name, value, Tensor, "a tensor")
    if valid.dtype != torch.bool:
        raise TypeError(f"valid must be a tensor of bool, such as depth > 0, got {valid.dtype}")
    if valid.shape != depth.shape or depth.ndim < 2:
        raise ValueError(f"depth and valid must have one shape (..., H, W), got {depth.shape} and {valid.shape}")
    if not depth.numel() or bool(valid.all()):
        return depth
    known = valid.flatten(0, -3) if valid.ndim > 2 else valid[None]
    if not bool(known.flatten(1).any(1).all()):
        raise ValueError("every depth map needs a valid pixel to be filled from, got one without")
    nearest = nearest_known(known).reshape(valid.shape)
    return depth.flatten(-2).gather(-1, nearest.flatten(-2)).reshape(depth.shape)


def nearest_known(known: Tensor) -> Tensor:
    """Return for each pixel the index of the nearest known one, counted along the rows.

    Args:
        known: (N, H, W) bool, at least one True in each.

    Returns:
        (N, H, W) int64.

    Example:
        >>> nearest_known(torch.tensor([[[True, False, False, True]]]))
        tensor([[[0, 0, 3, 3]]])
    """
    height, width = known.shape[-2:]
    far = 4 * (height + width)  # farther than any pixel from any other
    y = torch.arange(height, device=known.device, dtype=torch.int32)[:, None].expand(height, width)
    x = torch.arange(width, device=known.device, dtype=torch.int32).expand(height, width)
    rows, columns = torch.where(known, y, far), torch.where(known, x, far)
    longest = 1 << max(0, max(height, width) - 1).bit_length()
    steps = [longest >> n for n in range(1, longest.bit_length())]
    for step in (*steps, 2, 1):
        rows, columns = _flooded(rows, columns, y, x, step, far)
    return rows.long() * width + columns.long()


def _flooded(rows: Tensor, columns: Tensor, y: Tensor, x: Tensor, step: int, far: int) -> tuple[Tensor, Tensor]:
    """Return each pixel's nearest known one, of those that it and its eight neighbours at this distance know."""
    height, width = y.shape
    if step >= max(height, width):
        return rows, columns
    around = [pad(part, (step, step, step, step), value=far) for part in (rows, columns)]
    least = (rows - y) ** 2 + (columns - x) ** 2
    for top in (0, step, 2 * step):
        for left in (0, step, 2 * step):
            if top == left == step:
                continue
            r, c = (part[..., top : top + height, left : left + width] for part in around)
            distance = (r - y) ** 2 + (c - x) ** 2
            nearer = distance < least
            least = torch.where(nearer, distance, least)
            rows, columns = torch.where(nearer, r, rows), torch.where(nearer, c, columns)
    return rows, columns
