"""Residual estimation: a network estimates the difference between the all-in-focus image and the capture."""

from __future__ import annotations

import torch
from torch import Tensor, nn


class Residual(nn.Module):
    """Adds the capture to a network's last maps, which estimate the all-in-focus image.

    The last convolution is initialised with zeros, so that the initial estimate is the capture itself. A short training
    then improves on the capture instead of learning to copy it.

    Args:
        network: network that ends in a convolution; its last maps are the image.
        channels: of the image.

    Shape:
        - image: (B, C, H, W), as the network takes it.
        - output: as the network's.

    Raises:
        ValueError: if the network does not end in a convolution, or has fewer maps than the image has channels.

    Source: He et al., Deep Residual Learning (CVPR 2016); Zhang et al., Beyond a Gaussian Denoiser (TIP 2017), for
    estimating the residual of an image; zero initialisation as in Goyal et al. (2017), section 5.1.

    Example:
        >>> from kornia_tidy.reconstruction.attention_unet import AttentionUNet
        >>> head = Residual(AttentionUNet(out_channels=4, width=4)).eval()
        >>> capture = torch.rand(1, 3, 20, 30)
        >>> depth, image = head(capture).split([1, 3], 1)
        >>> bool((image == capture).all()), bool((depth == 0).all())
        (True, True)
    """

    def __init__(self, network: nn.Module, channels: int = 3) -> None:
        super().__init__()
        zero_last_convolution(network, channels)
        self.network, self.channels = network, channels

    def forward(self, image: Tensor) -> Tensor:
        """Return the maps, with the capture added to the last ones."""
        maps = self.network(image)
        others = maps.shape[1] - self.channels
        return torch.cat([maps[:, :others], maps[:, others:] + image], 1)


def zero_last_convolution(network: nn.Module, channels: int, name: str = "the network of a residual") -> None:
    """Initialise the last convolution of a network with zeros.

    Args:
        network: a network.
        channels: least number of its maps.
        name: of the network in messages.

    Raises:
        ValueError: if the network does not end in a convolution, or has fewer maps than ``channels``.
    """
    last = list(network.modules())[-1]
    if not isinstance(last, nn.Conv2d) or last.out_channels < channels:
        raise ValueError(
            f"{name} must end in a convolution to {channels} maps or more, {type(network).__name__} ends in {last}"
        )
    with torch.no_grad():
        for parameter in last.parameters():
            parameter.zero_()
