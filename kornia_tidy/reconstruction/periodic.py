"""Planes that repeat: an image leads smoothly from its end back to its beginning, so a Fourier inverse sees no edge."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def periodic_extension(image: Tensor, size: tuple[int, int]) -> Tensor:
    r"""Return the image with rows below and columns on the right that lead from its last ones back to its first.

    .. math:: (1 - w) \, x_{after} + w \, x_{before}, \qquad w = \sin^2 \frac{\pi}{2} \frac{j}{n + 1}

    for the j-th of n added pixels: the mirror image beyond the end fades into the mirror image before the beginning.

    Args:
        image: (..., H, W).
        size: height and width to reach, not below the image's.

    Returns:
        (..., *size); the image itself stands unchanged in the upper left corner.

    Example:
        >>> periodic_extension(torch.tensor([[0.0, 0.0, 6.0, 6.0]]), (1, 7)).round(decimals=3)
        tensor([[0., 0., 6., 6., 6., 3., 0.]])
    """
    for axis, length in ((-2, size[0]), (-1, size[1])):
        image = torch.cat([image, _bridge(image, axis, length - image.shape[axis])], dim=axis)
    return image


def _bridge(image: Tensor, axis: int, count: int) -> Tensor:
    """What stands between the image's end and its next repetition along one axis."""
    last = image.shape[axis] - 1
    step = torch.arange(1, count + 1, device=image.device)
    after = image.index_select(axis, _mirrored(last + step, last))
    before = image.index_select(axis, _mirrored(step - count - 1, last))
    weight = (math.pi / 2 * step.to(image.dtype) / (count + 1)).sin().square()
    weight = weight[:, None] if axis == -2 else weight
    return torch.lerp(after, before, weight)


def _mirrored(index: Tensor, last: int) -> Tensor:
    """The pixel from 0 to ``last`` that stands at an index beyond them, mirrored as often as it takes."""
    if last == 0:
        return torch.zeros_like(index)
    index = index.remainder(2 * last)
    return torch.minimum(index, 2 * last - index)
