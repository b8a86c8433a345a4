"""Attention U-Net: an encoder, a decoder, and gates that choose what the decoder sees of the encoder's detail."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from kornia_tidy.reconstruction.head import ReconstructionHead, check_count
from kornia_tidy.reconstruction.unet import LEVELS, conv_block, conv_unit, encode


class AttentionUNet(ReconstructionHead):
    r"""U-Net whose skip connections pass an attention gate, without a final activation.

    Five levels of two 3x3 convolutions (width, 2, 4, 8 and 16 times width channels), joined by 2x2 maximum pooling on
    the way down and by nearest upsampling and a 3x3 convolution on the way up. On each level the upsampled decoder
    :math:`g` gates the encoder's features :math:`x` before both are concatenated:

    .. math:: \hat x = x \cdot \sigma(\mathrm{BN}(w^T \max(0, \mathrm{BN}(W_x x) + \mathrm{BN}(W_g g))))

    Args:
        in_channels: channels of the image.
        out_channels: maps to estimate: 3 for an all-in-focus image, 4 with depth (see :class:`JointHead`).
        width: channels of the first level, at least 2. The paper's network has 64; its parameters go with the square.

    Shape:
        - image: (B, in_channels, H, W), any size; see :class:`ReconstructionHead` for the borders.
        - output: (B, out_channels, H, W), any real number.

    Convention:
        - Starts from :meth:`ReconstructionHead.reset_parameters`: normalisation follows every convolution but the
          last, so that its initial scale does not matter; the last one starts with outputs of order one.

    Source: Oktay et al., Attention U-Net (MIDL 2018). The gate works at the full resolution of its level instead of
    the coarser one, as in the five-level form commonly used with PyTorch (34,878,703 parameters for three outputs),
    and as time-averaged dynamic PSFs are evaluated with.

    Example:
        >>> head = AttentionUNet(width=4).eval()
        >>> head(torch.rand(1, 3, 50, 70)).shape
        torch.Size([1, 3, 50, 70])
    """

    stride = 2 ** (LEVELS - 1)

    def __init__(self, in_channels: int = 3, out_channels: int = 3, width: int = 64) -> None:
        super().__init__(in_channels, out_channels)
        check_count("width", width, least=2)
        channels = [width << level for level in range(LEVELS)]
        steps = list(pairwise(channels))
        self.encoder = nn.ModuleList(conv_block(i, o) for i, o in [(in_channels, width), *steps])
        self.decoder = nn.ModuleList(_GatedLevel(coarse, fine) for fine, coarse in reversed(steps))
        self.output = nn.Conv2d(width, out_channels, 1)
        self.reset_parameters()

    def predict(self, image: Tensor) -> Tensor:
        """Return the maps of an image whose sides are multiples of 16."""
        features, skips = encode(self.encoder, image)
        for level in self.decoder:
            features = level(features, skips.pop())
        return self.output(features)


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
    """Additive attention: one weight between 0 and 1 per pixel, from what the decoder and the encoder see there."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        inner = channels // 2
        self.decoder = nn.Sequential(nn.Conv2d(channels, inner, 1), nn.BatchNorm2d(inner))
        self.encoder = nn.Sequential(nn.Conv2d(channels, inner, 1), nn.BatchNorm2d(inner))
        self.weight = nn.Sequential(nn.Conv2d(inner, 1, 1), nn.BatchNorm2d(1), nn.Sigmoid())

    def forward(self, features: Tensor, skip: Tensor) -> Tensor:
        return skip * self.weight(functional.relu(self.decoder(features) + self.encoder(skip), inplace=True))
