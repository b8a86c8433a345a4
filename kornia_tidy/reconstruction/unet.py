"""The U-Net behind both network architectures: encoder, skip connections, decoder, and their convolutions."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

from torch import Tensor, nn
from torch.nn import functional

from kornia_tidy.checks import check_count
from kornia_tidy.reconstruction.head import ReconstructionHead

LEVELS = 5


class UNet(ReconstructionHead):
    """Base of the U-Nets: five levels of two 3x3 convolutions, joined by 2x2 maximum pooling on the way down.

    A subclass adds the module ``output``, from the features of the finest level to the maps.

    Args:
        in_channels: channels of the image.
        out_channels: maps to estimate.
        width: channels of the finest level; each level has twice those of the one above it.
        decoder_level: makes one level of the decoder from the channels of the coarser and of the finer level. It takes
            the coarser features and the encoder's features of the finer level.
        eps: of the batch normalisation.
    """

    stride = 2 ** (LEVELS - 1)
    output: nn.Module

    def __init__(
        self,
        in_channels: int,
        out_channels: int,
        width: int,
        decoder_level: Callable[[int, int], nn.Module],
        eps: float = 1e-5,
    ) -> None:
        super().__init__(in_channels, out_channels)
        check_count("width", width)
        steps = list(pairwise(width << level for level in range(LEVELS)))
        self.encoder = nn.ModuleList(conv_block(i, o, eps) for i, o in [(in_channels, width), *steps])
        self.decoder = nn.ModuleList(decoder_level(coarse, fine) for fine, coarse in reversed(steps))

    def predict(self, image: Tensor) -> Tensor:
        """Return the maps of an image with sides that are multiples of 16."""
        *finer, coarsest = self.encoder
        skips = []
        for level in finer:
            skips.append(level(image))
            image = functional.max_pool2d(skips[-1], 2)
        features = coarsest(image)
        for level in self.decoder:
            features = level(features, skips.pop())
        return self.output(features)


def conv_block(inputs: int, outputs: int, eps: float = 1e-5) -> nn.Sequential:
    """Return two units of :func:`conv_unit`. ``eps`` is that of the batch normalisation."""
    return nn.Sequential(*conv_unit(inputs, outputs, eps), *conv_unit(outputs, outputs, eps))


def conv_unit(inputs: int, outputs: int, eps: float = 1e-5) -> nn.Sequential:
    """Return a 3x3 convolution, batch normalisation and ReLU.

    The ReLU works in place: no gradient needs the normalised values.
    """
    convolution = nn.Conv2d(inputs, outputs, 3, padding=1)
    return nn.Sequential(convolution, nn.BatchNorm2d(outputs, eps=eps), nn.ReLU(inplace=True))
