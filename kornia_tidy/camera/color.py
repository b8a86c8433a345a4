"""Colour conversions for images of any number of channels."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor


def any_channels(function: Callable[[Tensor], Tensor], image: Tensor) -> Tensor:
    """Apply a conversion of kornia's, which wants three channels, to images of any number.

    Args:
        function: takes and returns (B, 3, H, W), and treats all channels alike.
        image: (B, C, H, W).

    Example:
        >>> import torch
        >>> any_channels(lambda image: 2 * image, torch.ones(1, 1, 1, 2))
        tensor([[[[2., 2.]]]])
    """
    planes = image.flatten(0, 1)[:, None]
    return function(planes.expand(-1, 3, -1, -1))[:, 0].reshape(image.shape)
