"""Bands of rows: a large image goes through the camera piece by piece, each with what its PSFs reach."""

from __future__ import annotations

import torch
from torch import Tensor

from kornia_tidy.render.borders import pad_border


def padded_band(image: Tensor, rows: slice, radius: int, border: str) -> Tensor:
    """Return some rows of the padded image, and ``radius`` more above and below.

    A convolution of the band that keeps only pixels which see the whole PSF (border ``"valid"``) gives the same rows
    as one of the whole image.

    Args:
        image: (B, C, H, W).
        rows: of the output, which is smaller than the image by ``2 * radius`` for ``"valid"``.
        radius: of the PSFs, in pixels.
        border: what lies beyond the image, see :mod:`kornia_tidy.render.borders`.

    Returns:
        (B, C, rows + 2 radius, W + 2 radius), or as wide as the image for ``"valid"``.

    Example:
        >>> image = torch.arange(12.0).view(1, 1, 4, 3)
        >>> padded_band(image, slice(0, 1), 1, "reflect")[0, 0, :, 1:-1].tolist()
        [[3.0, 4.0, 5.0], [0.0, 1.0, 2.0], [3.0, 4.0, 5.0]]
    """
    if border == "valid":
        return image[..., rows.start : rows.stop + 2 * radius, :]
    last = image.shape[-2] - 1
    index = torch.arange(rows.start - radius, rows.stop + radius, device=image.device)
    within = {
        "reflect": last - (last - index.abs()).abs(),
        "replicate": index.clamp(0, last),
        "zero": index.clamp(0, last),
        "circular": index % (last + 1),
    }[border]
    band = image.index_select(-2, within)
    if border == "zero":
        band[..., index != within, :] = 0
    return pad_border(band, (radius, 0), border)
