"""Bilateral filter whose width in colour may differ from pixel to pixel, as the noise does."""

from __future__ import annotations

import torch
from torch import Tensor

from kornia_tidy.checks import check_float_tensor
from kornia_tidy.render.borders import pad_border


def bilateral_filter(image: Tensor, color: Tensor | float, window: int = 7, space: float = 2.0) -> Tensor:
    r"""Smooth an image by averages over neighbours of similar colour.

    .. math:: z(x) = \frac{\sum_u w \, y(x + u)}{\sum_u w}, \quad
              w = \exp \Big( -\frac{|y(x + u) - y(x)|_1^2}{2 c(x)^2} - \frac{|u|^2}{2 s^2} \Big)

    :func:`kornia.filters.bilateral_blur` is the same filter for one width in colour a sample. Neighbours are added one
    after the other, so that no copies of the whole window are held.

    Args:
        image: y, (B, C, H, W).
        color: c, the width in colour, in units of the image: a number, or (B, 1, H, W) or what broadcasts to it.
        window: side of the neighbourhood in pixels, odd.
        space: s, the width in space, in pixels.

    Returns:
        (B, C, H, W) in the dtype of the image.

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
    total, weighted, scale = torch.zeros_like(image[:, :1]), torch.zeros_like(image), -0.5 / color**2
    for down in range(window):
        for across in range(window):
            other = padded[..., down : down + height, across : across + width]
            apart = (other - image).abs().sum(1, keepdim=True)
            distance = ((down - radius) ** 2 + (across - radius) ** 2) / space**2
            weight = (apart.square() * scale - 0.5 * distance).exp()
            total, weighted = total + weight, torch.addcmul(weighted, weight, other)
    return weighted / total
