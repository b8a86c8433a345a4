"""The U-Net of PhaseCam3D, the first learnt phase mask for depth: a baseline."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from kornia_tidy.reconstruction.unet import UNet, conv_block

EPSILON = 1e-3  # of the batch normalisation, as in TensorFlow, in which the network was published


class PhaseCam3DUNet(UNet):
    """U-Net with transposed convolutions and, at its end, batch normalisation and a sigmoid.

    Five levels of two 3x3 convolutions (width, 2, 4, 8 and 16 times width channels), joined by 2x2 maximum pooling on
    the way down and by a 3x3 transposed convolution of stride 2 on the way up.

    Args:
        in_channels: channels of the image.
        out_channels: maps to estimate: 1 for normalised defocus.
        width: channels of the first level. PhaseCam3D has 32.

    Shape:
        - image: (B, in_channels, H, W), any size; for the borders see
          :class:`~kornia_tidy.reconstruction.ReconstructionHead`.
        - output: (B, out_channels, H, W) between 0 and 1. PhaseCam3D's defocus is linear in it.

    Convention:
        - The transposed convolution is aligned as TensorFlow's ``SAME``: pixel i reaches pixels 2i, 2i + 1, 2i + 2.
        - Initial weights are those of :meth:`~kornia_tidy.reconstruction.ReconstructionHead.reset_parameters`. Batch
          normalisation follows every convolution directly or after the next one, so that the scale of these does not
          matter; the initial outputs lie around 1/2.

    Source: Wu et al., PhaseCam3D (ICCP 2019), and the network published with it.

    Example:
        >>> head = PhaseCam3DUNet(width=4).eval()
        >>> head(torch.rand(1, 3, 50, 70)).shape
        torch.Size([1, 1, 50, 70])
    """

    def __init__(self, in_channels: int = 3, out_channels: int = 1, width: int = 32) -> None:
        super().__init__(in_channels, out_channels, width, _Level, EPSILON)
        self.output = nn.Sequential(
            nn.Conv2d(width, out_channels, 1), nn.BatchNorm2d(out_channels, eps=EPSILON), nn.Sigmoid()
        )
        self.reset_parameters()


class _Level(nn.Module):
    """One step up: upsample, concatenate the encoder's features, merge."""

    def __init__(self, coarse: int, fine: int) -> None:
        super().__init__()
        self.up = nn.ConvTranspose2d(coarse, fine, 3, stride=2, bias=False)
        self.merge = conv_block(2 * fine, fine, EPSILON)

    def forward(self, features: Tensor, skip: Tensor) -> Tensor:
        return self.merge(torch.cat([self.up(features)[..., :-1, :-1], skip], 1))
