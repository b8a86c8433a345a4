"""What the U-Nets share: units of convolution, normalisation and rectification, and the way down."""

from __future__ import annotations

from torch import Tensor, nn
from torch.nn import functional

LEVELS = 5


def encode(levels: nn.ModuleList, image: Tensor) -> tuple[Tensor, list[Tensor]]:
    """Run the way down of a U-Net. Return the coarsest features and, finest first, those of the levels above."""
    *finer, coarsest = levels
    skips = []
    for level in finer:
        skips.append(level(image))
        image = functional.max_pool2d(skips[-1], 2)
    return coarsest(image), skips


def conv_block(inputs: int, outputs: int, eps: float = 1e-5) -> nn.Sequential:
    """Return two 3x3 convolutions, each normalised and rectified. ``eps`` is the normalisation's."""
    return nn.Sequential(*conv_unit(inputs, outputs, eps), *conv_unit(outputs, outputs, eps))


def conv_unit(inputs: int, outputs: int, eps: float = 1e-5) -> nn.Sequential:
    """Return a 3x3 convolution, normalised and rectified.

    The rectifier works in place: neither it nor the normalisation needs the values in between for its gradient.
    """
    convolution = nn.Conv2d(inputs, outputs, 3, padding=1)
    return nn.Sequential(convolution, nn.BatchNorm2d(outputs, eps=eps), nn.ReLU(inplace=True))
