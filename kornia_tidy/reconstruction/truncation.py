"""Truncation of filters to a window of a few PSFs, which bounds how far a network sees."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kornia_tidy.render.borders import next_fast_size

SIDE = 3  # windows of a PSF: side of the filters
_PLANE = 8  # windows of a PSF: side of the plane in which filters are computed, so that they hardly wrap around


def plane_of(psfs: Tensor) -> int:
    """Return the side of the periodic plane in which the filters of PSFs (..., P, P) are computed.

    Example:
        >>> plane_of(torch.zeros(1, 29, 29))
        240
    """
    return next_fast_size(_PLANE * psfs.shape[-1])


def truncated(filters: Tensor, side: int) -> Tensor:
    """Truncate filters on a periodic plane to a window, and keep their sums.

    A raised cosine fades them out over the outer half of their radius. A multiple of it compensates the truncated part.

    Args:
        filters: (..., M, M), centred at the first pixel.
        side: of the window in pixels, odd.

    Returns:
        (..., side, side), centred at the middle.

    Example:
        >>> truncated(torch.full((9, 9), 1.0), 3).sum().round()
        tensor(81.)
    """
    cut = filters.roll((side // 2, side // 2), (-2, -1))[..., :side, :side]
    place = torch.linspace(-1, 1, side + 2, dtype=filters.dtype, device=filters.device)[1:-1].abs()
    fade = (0.5 + 0.5 * torch.cos(math.pi * (2 * place - 1).clamp(min=0))).unsqueeze(-1)
    fade = fade * fade.mT
    cut = cut * fade
    missing = filters.sum((-2, -1), keepdim=True) - cut.sum((-2, -1), keepdim=True)
    return cut + missing * (fade / fade.sum())
