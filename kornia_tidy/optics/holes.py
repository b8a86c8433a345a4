"""Holes of depth maps: pixels of unknown depth, filled from the nearest known pixel."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from kornia_tidy.checks import check_part, check_values
from kornia_tidy.mode import Mode, torch_mode
from kornia_tidy.search_path import import_installed

HOLES = ("error", "fill")  # how a camera and its adapters treat holes
_UNSIGNED = (torch.uint16, torch.uint32, torch.uint64)  # types that torch stores, and neither compares nor gathers

Depth = TypeVar("Depth", Tensor, np.ndarray)

torch.library.define("kornia_tidy::nearest_known", "(Tensor known) -> Tensor")


def fill_holes(depth: Depth) -> tuple[Depth, Depth]:
    """Fill the holes of depth maps from the nearest known pixel.

    A hole is a depth of NaN, 0 or less, or a masked value of a masked array. Infinity is a depth.

    Args:
        depth: metres, or any unit in which 0 means unknown; floating point or whole numbers.

    Returns:
        The depth without holes, in its data type and on its device, and the mask of known pixels, bool. Without a hole
        it is the depth itself, not a copy.

    Shape:
        - A tensor (..., H, W), or an array (H, W), (H, W, 1) or (B, H, W, 1); both results have this shape. Each map
          (H, W) is filled by itself.

    Raises:
        TypeError: if the depth is not a tensor or array, or holds other numbers.
        ValueError: if the shape is another, or a map consists of holes.

    Convention:
        - Distances are Euclidean, between the centres of pixels.
        - Gradients reach the pixels that values were taken from.
        - The distances are computed on the CPU, in compiled graphs by the operator ``kornia_tidy::nearest_known``; the
          mask of an accelerator's depth is copied there.

    Source: SciPy's ``distance_transform_edt``; Maurer, Qi and Raghavan, A linear time algorithm for computing exact
    Euclidean distance transforms of binary images in arbitrary dimensions, PAMI 2003.

    Example:
        >>> fill_holes(torch.tensor([[2.0, 0.0, torch.nan, torch.inf]]))
        (tensor([[2., 2., inf, inf]]), tensor([[ True, False, False,  True]]))
        >>> fill_holes(np.array([[500, 0, 0, 2000]], np.uint16))[0]
        array([[ 500,  500, 2000, 2000]], dtype=uint16)
    """
    filled: Any = _fill_tensor(depth) if isinstance(depth, Tensor) else _fill_array(depth)
    return filled


def _fill_array(depth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    check_part("depth", depth, np.ndarray, "a tensor or an array")
    if depth.dtype.kind not in "uif":
        raise TypeError(f"depth must hold numbers, got {depth.dtype}")
    if depth.ndim != 2 and not (depth.ndim in {3, 4} and depth.shape[-1] == 1):
        raise ValueError(f"depth must be an array (H, W), (H, W, 1) or (B, H, W, 1), got {depth.shape}")
    values = np.asarray(depth)
    known = (values > 0) & ~np.ma.getmaskarray(depth)  # False for NaN
    if known.all():
        return values, known
    maps = known.shape if depth.ndim == 2 else known.shape[:-1]
    length = maps[-2] * maps[-1]
    nearest = _nearest(known.reshape(-1, *maps[-2:])).reshape(-1, length)
    return np.take_along_axis(values.reshape(-1, length), nearest, 1).reshape(values.shape), known


def _fill_tensor(depth: Tensor) -> tuple[Tensor, Tensor]:
    if depth.is_complex() or depth.dtype == torch.bool:
        raise TypeError(f"depth must hold numbers, got {depth.dtype}")
    if depth.ndim < 2:
        raise ValueError(f"depth must be a tensor (..., H, W), got {tuple(depth.shape)}")
    check_values("depth", depth)
    wide = depth.long() if depth.dtype in _UNSIGNED else depth
    known = wide > 0  # False for NaN
    if not depth.numel() or (Mode.GRAPH not in torch_mode() and bool(known.all())):
        return depth, known
    nearest = torch.ops.kornia_tidy.nearest_known(known)
    filled = wide.flatten(-2).gather(-1, nearest.flatten(-2)).reshape(depth.shape)
    return filled.to(depth.dtype), known


def _nearest(known: np.ndarray) -> np.ndarray:
    """Return for each pixel of maps (N, H, W) the index of the nearest known one, counted along the rows of its map."""
    transform = import_installed("scipy.ndimage").distance_transform_edt  # 0.2 s, which only holes need
    nearest = np.empty(known.shape, np.int64)
    for i, one in enumerate(known):
        if not one.any():
            raise ValueError(
                f"depth must be known at one pixel or more, and map {i} of {len(known)} holds 0, NaN or masked pixels "
                f"alone"
            )
        rows, columns = transform(~one, return_distances=False, return_indices=True)
        nearest[i] = rows.astype(np.int64) * one.shape[1] + columns
    return nearest


def _nearest_known(known: Tensor) -> Tensor:
    """Return :func:`_nearest` of a tensor (..., H, W) on its device."""
    nearest = _nearest(known.reshape(-1, *known.shape[-2:]).cpu().numpy())
    return torch.from_numpy(nearest).reshape(known.shape).to(known.device)


def _nearest_known_of_axis(_: Any, axes: tuple[int], known: Tensor) -> tuple[Tensor, int]:
    return torch.ops.kornia_tidy.nearest_known(known.movedim(axes[0], 0)), 0


torch.library.impl("kornia_tidy::nearest_known", "default", _nearest_known)
torch.library.register_fake("kornia_tidy::nearest_known", lambda known: known.new_empty(known.shape, dtype=torch.int64))
torch.library.register_vmap("kornia_tidy::nearest_known", _nearest_known_of_axis)
