"""Attention U-Net: a U-Net with attention gates in its skip connections."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional

from kornia_tidy.checks import check_count
from kornia_tidy.reconstruction.unet import UNet, conv_block, conv_unit


class AttentionUNet(UNet):
    r"""U-Net with an attention gate in each skip connection and without a final activation.

    Five levels of two 3x3 convolutions (width, 2, 4, 8 and 16 times width channels), joined by 2x2 maximum pooling on
    the way down and by nearest upsampling and a 3x3 convolution on the way up. On each level the upsampled decoder
    :math:`g` gates the encoder's features :math:`x` before both are concatenated:

    .. math:: \hat x = x \cdot \sigma(\mathrm{BN}(w^T \max(0, \mathrm{BN}(W_x x) + \mathrm{BN}(W_g g))))

    Args:
        in_channels: channels of the image.
        out_channels: maps to estimate: 3 for an all-in-focus image, 4 with depth (see :class:`JointHead`).
        width: channels of the first level, at least 2. The paper's network has 64. The number of parameters
            grows as the square of the width.

    Shape:
        - image: (B, in_channels, H, W), any size; for the borders see
          :class:`~kornia_tidy.reconstruction.ReconstructionHead`.
        - output: (B, out_channels, H, W), any real number.

    Convention:
        - Initial weights are those of :meth:`~kornia_tidy.reconstruction.ReconstructionHead.reset_parameters`. Batch
          normalisation follows every convolution but the last, so that the scale of these does not matter; the initial
          outputs of the last one are of order one.

    Source: Oktay et al., Attention U-Net (MIDL 2018). The gate works at the full resolution of its level instead of
    that of the coarser level, as in the five-level form commonly used with PyTorch (34,878,703 parameters for three
    outputs), with which TiDy-PSFs were evaluated.

    Example:
        >>> head = AttentionUNet(width=4).eval()
        >>> head(torch.rand(1, 3, 50, 70)).shape
        torch.Size([1, 3, 50, 70])
    """

    def __init__(self, in_channels: int = 3, out_channels: int = 3, width: int = 64) -> None:
        check_count("width", width, least=2)
        super().__init__(in_channels, out_channels, width, _GatedLevel)
        self.output = nn.Conv2d(width, out_channels, 1)
        self.reset_parameters()


class _GatedLevel(nn.Module):
    """One step up: upsample, gate the encoder's features, merge."""

    def __init__(self, coarse: int, fine: int) -> None:
        super().__init__()
        self.up = conv_unit(coarse, fine)
        self.gate = _AttentionGate(fine)
        self.merge = conv_block(2 * fine, fine)

    def forward(self, features: Tensor, skip: Tensor) -> Tensor:
        features = self.up(functional.interpolate(features, scale_factor=2.0, mode="nearest"))
        return self.merge(torch.cat([self.gate(features, skip), features], 1))


class _AttentionGate(nn.Module):
    """Additive attention: one weight between 0 and 1 per pixel, from the decoder's and the encoder's features."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        inner = channels // 2
        self.decoder = nn.Sequential(nn.Conv2d(channels, inner, 1), nn.BatchNorm2d(inner))
        self.encoder = nn.Sequential(nn.Conv2d(channels, inner, 1), nn.BatchNorm2d(inner))
        self.weight = nn.Sequential(nn.Conv2d(inner, 1, 1), nn.BatchNorm2d(1), nn.Sigmoid())

    def forward(self, features: Tensor, skip: Tensor) -> Tensor:
        return skip * self.weight(functional.relu(self.decoder(features) + self.encoder(skip), inplace=True))
