"""Restoration behind a real lens: each tile of a capture by the PSFs of its place, blended without seams."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from kornia_tidy.checks import check_float_tensor
from kornia_tidy.psf.psf_bank import PSFBank
from kornia_tidy.psf.psf_model import PSFModel

TILE = 192  # px along a side


def restored_over_field(
    capture: Tensor,
    model: PSFModel,
    restore: Callable[[Tensor, PSFBank], Tensor],
    *,
    center: tuple[float, float] = (0.0, 0.0),
    defocus: tuple[float, float] | None = None,
    tile: int = TILE,
    progress: Callable[[int, int], object] | None = None,
) -> Tensor:
    """Restore a capture through a real lens by a restoration that knows one PSF for each depth.

    Tiles overlap by half of their sides. Each is restored with as much of the capture around it as PSFs reach twice,
    and their weights, which fall from the middle to the edges, sum to one.

    Args:
        capture: (B, C, H, W).
        model: of the camera, as ``optics.psf_model``. With an ideal lens the whole capture is restored at once.
        restore: from a capture and PSFs to an image of its size, such as
            ``lambda part, bank: Wiener(sensor)(part, bank)``.
        center: of the capture, y and x in sensor pixels from the lens's axis: ``optics.field_center``.
        defocus: lowest and highest of the scene in radians. Default: the camera's range.
        tile: side of the tiles in pixels, at least 2.
        progress: called with the number of finished tiles and of all tiles, after each.

    Returns:
        (B, C, H, W).

    Raises:
        TypeError: if the capture is not floating point.
        ValueError: if it has another shape, or tiles are smaller.

    Convention:
        - PSFs carry the light of their place, so that a restoration which divides by it mends vignetting.

    Example:
        >>> from kornia_tidy import SensorNoise
        >>> from kornia_tidy.reconstruction import Wiener
        >>> model, wiener = PSFModel(fidelity="draft"), Wiener(SensorNoise(0.01))
        >>> restored_over_field(torch.rand(1, 3, 40, 50), model, wiener).shape
        torch.Size([1, 3, 40, 50])
    """
    check_float_tensor("capture", capture, 4, "(B, C, H, W)")
    if tile < 2:
        raise ValueError(f"tile must be at least 2 pixels, got {tile}")
    size = capture.shape[-2], capture.shape[-1]
    ends = torch.tensor(model.camera.defocus_range if defocus is None else defocus, dtype=torch.float64)
    dtype = torch.promote_types(capture.dtype, torch.float32)
    if (field := model.field_of(size, center)) is None:
        return restore(capture, model.scene_bank(capture.shape[1], dtype, ends, device=capture.device))
    bank, reach = model.scene_bank(capture.shape[1], dtype, ends, field=field), model.window - 1
    total = torch.zeros_like(capture, dtype=dtype)
    (rows, down), (columns, across) = (_places(side, tile) for side in size)
    done, tiles = 0, len(rows) * len(columns)
    for top, weight in zip(rows, down, strict=True):
        for left, beside in zip(columns, across, strict=True):
            bottom, right = top + len(weight), left + len(beside)
            y, x = max(0, top - reach), max(0, left - reach)
            part = capture[..., y : bottom + reach, x : right + reach]
            psfs = bank.between(field, ((top + bottom - 1) / 2, (left + right - 1) / 2))
            own = restore(part, psfs)[..., top - y : bottom - y, left - x : right - x]
            total[..., top:bottom, left:right] += own * (weight[:, None] * beside).to(own)
            done += 1
            if progress is not None:
                progress(done, tiles)
    return total.to(capture.dtype)


def _places(side: int, tile: int) -> tuple[list[int], list[Tensor]]:
    """Return where tiles begin along an axis, half overlapping, and the weights of their pixels, which sum to one.

    Example:
        >>> places, weights = _places(6, 4)
        >>> places, [weight.tolist() for weight in weights]
        ([0, 2], [[1.0, 1.0, 0.75, 0.25], [0.25, 0.75, 1.0, 1.0]])
    """
    half = tile // 2
    count = max(1, -(-side // half) - 1)
    places = [i * half for i in range(count)]
    ramp = (torch.arange(half) + 0.5) / half
    weights = []
    for i, first in enumerate(places):
        last = side if i == count - 1 else first + 2 * half
        weight = torch.ones(last - first)
        if i > 0:
            weight[:half] = ramp
        if i < count - 1:
            weight[half : 2 * half] = 1 - ramp
        weights.append(weight)
    return places, weights
