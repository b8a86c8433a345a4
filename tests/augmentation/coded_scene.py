"""A scene that carries the proof of its alignment, and optics that write down what depth they were given.

The green channel of the image is a code of its depth. Where an augmented image and its depth still agree pixel for
pixel, they were moved alike. The optics do not blur: they mark each pixel with the depth that they would blur it by.
"""

from __future__ import annotations

from collections.abc import Mapping

import kornia.augmentation as K
import torch
from torch import Tensor

from kornia_tidy.augmentation import DepthAugmentation

SIDE = 32
MOVED = 1e-3  # kornia turns by interpolation, which rounds; a pixel of another place differs by 0.27 on average


class ThirdChannel(K.IntensityAugmentationBase2D):
    """A colour change that leaves the code of the depth alone."""

    def __init__(self) -> None:
        super().__init__(p=1.0)

    def apply_transform(self, image: Tensor, params: object, flags: object, transform: object = None) -> Tensor:
        return image * image.new_tensor([1.0, 1.0, 0.5]).view(1, 3, 1, 1)


class MarkDepth(DepthAugmentation):
    """Writes the depth that it is given into the first channel, where the optics would blur by it."""

    def change(self, image: Tensor, depth: Tensor, params: Mapping[str, Tensor]) -> Tensor:
        return torch.cat([depth.expand(len(image), -1, -1, -1).to(image), image[:, 1:]], 1)


def coded_scene() -> tuple[Tensor, Tensor]:
    depth = 0.1 + 0.8 * torch.rand(2, 1, SIDE, SIDE, generator=torch.Generator().manual_seed(3))
    return torch.cat([torch.zeros_like(depth), depth, torch.rand(2, 1, SIDE, SIDE)], 1), depth


def assert_aligned(image: Tensor, depth: Tensor) -> None:
    """The optics saw the depth of each pixel, and the depth that comes out is that of each pixel, too."""
    known = (depth > 0)[:, 0] & (image[:, 1] > 0)
    assert known.float().mean() > 0.5
    assert (image[:, 1] - image[:, 0])[known].abs().max() < MOVED
    assert (image[:, 1] - depth[:, 0])[known].abs().max() < MOVED
