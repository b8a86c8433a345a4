"""The U-Net of PhaseCam3D: the network of the first learnt phase mask for depth, as a baseline."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor, nn

from kornia_tidy.reconstruction.head import ReconstructionHead, check_count
from kornia_tidy.reconstruction.unet import LEVELS, conv_block, encode

EPSILON = 1e-3  # of the normalisation: TensorFlow's, where the network comes from


class PhaseCam3DUNet(ReconstructionHead):
    """U-Net with transposed convolutions and a normalised sigmoid at its end.

    Five levels of two 3x3 convolutions (width, 2, 4, 8 and 16 times width channels), joined by 2x2 maximum pooling on
    the way down and by a 3x3 transposed convolution of stride 2 on the way up.

    Args:
        in_channels: channels of the image.
        out_channels: maps to estimate: 1 for normalised defocus.
        width: channels of the first level. PhaseCam3D has 32.

    Shape:
        - image: (B, in_channels, H, W), any size; see :class:`ReconstructionHead` for the borders.
        - output: (B, out_channels, H, W) between 0 and 1. PhaseCam3D's defocus is linear in it.

    Convention:
        - The transposed convolution is aligned as TensorFlow's ``SAME``: pixel i reaches pixels 2i, 2i + 1, 2i + 2.
        - Starts from :meth:`ReconstructionHead.reset_parameters`: normalisation follows every convolution directly or
          after the next one, so that their initial scale does not matter; the output starts around 1/2.

    Source: Wu et al., PhaseCam3D (ICCP 2019), and the network published with it.

    Example:
        >>> head = PhaseCam3DUNet(width=4).eval()
        >>> head(torch.rand(1, 3, 50, 70)).shape
        torch.Size([1, 1, 50, 70])
    """

    stride = 2 ** (LEVELS - 1)

    def __init__(self, in_channels: int = 3, out_channels: int = 1, width: int = 32) -> None:
        super().__init__(in_channels, out_channels)
        check_count("width", width)
        channels = [width << level for level in range(LEVELS)]
        steps = list(pairwise(channels))
        self.encoder = nn.ModuleList(conv_block(i, o, EPSILON) for i, o in [(in_channels, width), *steps])
        self.decoder = nn.ModuleList(_Level(coarse, fine) for fine, coarse in reversed(steps))
        self.output = nn.Sequential(
            nn.Conv2d(width, out_channels, 1), nn.BatchNorm2d(out_channels, eps=EPSILON), nn.Sigmoid()
        )
        self.reset_parameters()

    def predict(self, image: Tensor) -> Tensor:
        """Return the maps of an image whose sides are multiples of 16."""
        features, skips = encode(self.encoder, image)
        for level in self.decoder:
            features = level(features, skips.pop())
        return self.output(features)


class _Level(nn.Module):
    """One step up: upsample, concatenate the encoder's features, merge."""

    def __init__(self, coarse: int, fine: int) -> None:
        super().__init__()
        self.up = nn.ConvTranspose2d(coarse, fine, 3, stride=2, bias=False)
        self.merge = conv_block(2 * fine, fine, EPSILON)

    def forward(self, features: Tensor, skip: Tensor) -> Tensor:
        return self.merge(torch.cat([self.up(features)[..., :-1, :-1], skip], 1))
