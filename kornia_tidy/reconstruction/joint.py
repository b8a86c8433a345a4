"""Depth and image from one network, as a named tuple."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor, nn

from kornia_tidy.reconstruction.depth_distribution import depth_moments
from kornia_tidy.reconstruction.head import ReconstructionHead


class JointEstimate(NamedTuple):
    """Estimates of a joint network: ``depth`` (B, 1, H, W) and the all-in-focus ``image`` (B, 3, H, W)."""

    depth: Tensor
    image: Tensor


class UncertainJointEstimate(NamedTuple):
    """A :class:`JointEstimate` with the uncertainty of its depth, each map (B, C, H, W)."""

    depth: Tensor
    """Mean of the distribution of depth, in parts of the range."""
    image: Tensor
    """All-in-focus image."""
    deviation: Tensor
    """Standard deviation of the depth, in parts of the range: from 0 to 0.5, 0.29 where nothing is known."""


class JointHead(nn.Module):
    """Splits the output channels of a network into depth, with its uncertainty, and all-in-focus image.

    Args:
        network: a reconstruction network with four output channels, depth first; or with D + 3, the logits of D
            classes of depth first, such as :class:`~kornia_tidy.reconstruction.LayeredJointHead`.

    Shape:
        - image: (B, C, H, W), as the network takes it.
        - output: of four channels :class:`JointEstimate` of depth (B, 1, H, W) and image (B, 3, H, W), which are views
          of one tensor; of more :class:`UncertainJointEstimate`, which adds the standard deviation of the depth.

    Raises:
        ValueError: if the network has fewer than four output channels.

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
        if network.out_channels < 4:
            raise ValueError(f"network must have 4 outputs, depth and three colours, got {network.out_channels}")
        self.network = network

    def forward(self, image: Tensor) -> JointEstimate | UncertainJointEstimate:
        """Return the estimated depth and image."""
        output = self.network(image)
        depth, image = output.split([output.shape[1] - 3, 3], 1)
        if depth.shape[1] == 1:
            return JointEstimate(depth, image)
        mean, deviation = depth_moments(depth)
        return UncertainJointEstimate(mean, image, deviation)
