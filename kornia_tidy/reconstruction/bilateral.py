"""Bilateral filter whose width in colour may differ from pixel to pixel, as the noise does."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kornia_tidy.checks import check_float_tensor
from kornia_tidy.reconstruction.strips import strip_rows
from kornia_tidy.render.borders import pad_border


def bilateral_filter(image: Tensor, color: Tensor | float, window: int = 7, space: float = 2.0) -> Tensor:
    r"""Smooth an image by averages over neighbours of similar colour.

    .. math:: z(x) = \frac{\sum_u w \, y(x + u)}{\sum_u w}, \quad
              w = \exp \Big( -\frac{|y(x + u) - y(x)|_1^2}{2 c(x)^2} - \frac{|u|^2}{2 s^2} \Big)

    :func:`kornia.filters.bilateral_blur` is the same filter for one width in colour a sample. Neighbours are added one
    after the other, so that no copies of the whole window are held.

    Args:
        image: y, (B, C, H, W).
        color: c, the width in colour, in units of the image: a number, or (B, 1, H, W) or what broadcasts with it, such
            as (K, B, 1, 1, 1) for K widths at once.
        window: side of the neighbourhood in pixels, odd.
        space: s, the width in space, in pixels.

    Returns:
        (B, C, H, W), or (K, B, C, H, W), in the dtype of the image.

    Raises:
        TypeError: if the image is not floating point.
        ValueError: if the image has another shape, or the window is not odd.

    Convention:
        Borders are reflected; if a side is too short for that, its outermost pixel is repeated.

    Source: Tomasi and Manduchi, Bilateral Filtering for Gray and Color Images (ICCV 1998).

    Example:
        >>> edge = torch.tensor([[0.0, 0.1, 0.0, 1.0, 0.9, 1.0]]).expand(1, 1, 6, 6)
        >>> bilateral_filter(edge, color=0.2)[0, 0, 3].round(decimals=2)
        tensor([0.0400, 0.0500, 0.0400, 0.9600, 0.9500, 0.9600])
    """
    check_float_tensor("image", image, 4, "(B, C, H, W)")
    if window % 2 == 0 or window < 1:
        raise ValueError(f"window must be odd and positive, got {window}")
    radius, (height, width) = window // 2, image.shape[-2:]
    padded = pad_border(image, radius, "reflect" if radius < min(height, width) else "replicate")
    scale = torch.as_tensor(-0.5 / color**2).to(image)
    scale = scale.expand(torch.broadcast_shapes(scale.shape, image[:, :1].shape))
    rows = strip_rows(image)
    strips = [
        _filtered(padded[..., top : top + rows + 2 * radius, :], scale[..., top : top + rows, :], radius, space)
        for top in range(0, height, rows)
    ]
    return torch.cat(strips, -2)


def _filtered(padded: Tensor, scale: Tensor, radius: int, space: float) -> Tensor:
    """Filter an image that is padded by a radius; the scale is that of squared differences of colour."""
    height, width = scale.shape[-2:]
    image = padded[..., radius : radius + height, radius : radius + width]
    total, weighted = torch.zeros_like(image[:, :1]), torch.zeros_like(image)
    for down in range(2 * radius + 1):
        for across in range(2 * radius + 1):
            other = padded[..., down : down + height, across : across + width]
            apart = (other - image).abs().sum(1, keepdim=True)
            weight = (apart.square() * scale).exp()
            near = math.exp(-0.5 * ((down - radius) ** 2 + (across - radius) ** 2) / space**2)
            total = torch.add(total, weight, alpha=near)
            weighted = torch.addcmul(weighted, weight, other, value=near)
    return weighted / total
