"""Depth and image from one network, as a named tuple."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor, nn

from kornia_tidy.reconstruction.head import ReconstructionHead


class JointEstimate(NamedTuple):
    """Estimates of a joint network: ``depth`` (B, 1, H, W) and the all-in-focus ``image`` (B, 3, H, W)."""

    depth: Tensor
    image: Tensor


class JointHead(nn.Module):
    """Splits the four output channels of a network into depth and all-in-focus image.

    Args:
        network: a reconstruction network with four output channels, depth first.

    Shape:
        - image: (B, C, H, W), as the network takes it.
        - output: :class:`JointEstimate` of depth (B, 1, H, W) and image (B, 3, H, W), which are views of one tensor.

    Raises:
        ValueError: if the network does not have four output channels.

    Convention:
        - Both are in the units of training, usually [0, 1]; a final activation of the network applies to both.

    Source: Shah et al., TiDy-PSFs (ICCV 2023), joint optimisation: an attention U-Net with four channels.

    Example:
        >>> import torch
        >>> from kornia_tidy.reconstruction.attention_unet import AttentionUNet
        >>> head = JointHead(AttentionUNet(out_channels=4, width=4)).eval()
        >>> estimate = head(torch.rand(1, 3, 32, 48))
        >>> estimate.depth.shape, estimate.image.shape
        (torch.Size([1, 1, 32, 48]), torch.Size([1, 3, 32, 48]))
    """

    def __init__(self, network: ReconstructionHead) -> None:
        super().__init__()
        if network.out_channels != 4:
            raise ValueError(f"network must have 4 outputs, depth and three colours, got {network.out_channels}")
        self.network = network

    def forward(self, image: Tensor) -> JointEstimate:
        """Return the estimated depth and image."""
        depth, image = self.network(image).split([1, 3], 1)
        return JointEstimate(depth, image)
