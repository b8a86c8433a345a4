"""Periodic extension of images for inversion by Fourier transform: a smooth path from the end to the beginning."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def periodic_extension(image: Tensor, size: tuple[int, int]) -> Tensor:
    r"""Return the image with added rows below and columns on the right that make its periodic repetition smooth.

    .. math:: (1 - w) \, x_{after} + w \, x_{before}, \qquad w = \sin^2 \frac{\pi}{2} \frac{j}{n + 1}

    for the j-th of n added pixels: a blend from the mirror image beyond the end to that before the beginning.

    Args:
        image: (..., H, W).
        size: height and width of the result, at least those of the image.

    Returns:
        (..., *size), with the unchanged image in the upper left corner.

    Example:
        >>> periodic_extension(torch.tensor([[0.0, 0.0, 6.0, 6.0]]), (1, 7)).round(decimals=3)
        tensor([[0., 0., 6., 6., 6., 3., 0.]])
    """
    for axis, length in ((-2, size[0]), (-1, size[1])):
        image = torch.cat([image, _bridge(image, axis, length - image.shape[axis])], dim=axis)
    return image


def _bridge(image: Tensor, axis: int, count: int) -> Tensor:
    """Return the pixels between the end of the image and its next repetition along one axis."""
    last = image.shape[axis] - 1
    step = torch.arange(1, count + 1, device=image.device)
    after = image.index_select(axis, _mirrored(last + step, last))
    before = image.index_select(axis, _mirrored(step - count - 1, last))
    weight = (math.pi / 2 * step.to(image.dtype) / (count + 1)).sin().square()
    weight = weight[:, None] if axis == -2 else weight
    return torch.lerp(after, before, weight)


def _mirrored(index: Tensor, last: int) -> Tensor:
    """Return the pixel from 0 to ``last`` at any index of the image repeated by reflection."""
    if last == 0:
        return torch.zeros_like(index)
    index = index.remainder(2 * last)
    return torch.minimum(index, 2 * last - index)
