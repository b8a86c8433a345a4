"""Random masks of a family by its name, for cameras that are made up."""

from __future__ import annotations

import torch

from kornia_tidy.checks import check_choice, check_generator
from kornia_tidy.choices import MASK_FAMILIES
from kornia_tidy.masks.base import PhaseMasks, check_number_of_masks
from kornia_tidy.masks.cubic import CubicMask
from kornia_tidy.masks.fourier import FourierMask
from kornia_tidy.masks.no_mask import NoMask
from kornia_tidy.masks.pixelwise import PixelwiseMask
from kornia_tidy.masks.radial import RadialMask
from kornia_tidy.masks.spiral import SpiralMask
from kornia_tidy.masks.zernike import ZernikeMask

CUBIC = 60.0  # rad, largest strength
SPIRAL_SIZE = 46  # pixels along a side


def random_masks(family: str, num_masks: int = 5, generator: torch.Generator | None = None) -> PhaseMasks:
    """Return masks of a family with random parameters.

    Args:
        family: a name of :data:`~kornia_tidy.choices.MASK_FAMILIES`; with ``"none"`` there is one flat mask.
        num_masks: number of masks in one exposure.
        generator: source of the randomness. Default: the global generator.

    Raises:
        ValueError: if there is no such family, or a number is not positive.

    Example:
        >>> random_masks("spiral", 3).phase.shape, random_masks("none").phase.shape
        (torch.Size([3, 46, 46]), torch.Size([1, 92, 92]))
    """
    check_choice("family", family, MASK_FAMILIES)
    check_number_of_masks(num_masks)
    check_generator(generator)
    if family == "none":
        return NoMask()
    if family == "cubic":
        return CubicMask(CUBIC * torch.rand(num_masks, generator=generator))
    if family == "spiral":
        return SpiralMask(num_masks, SPIRAL_SIZE, generator=generator)
    kinds = {"pixelwise": PixelwiseMask, "fourier": FourierMask, "radial": RadialMask, "zernike": ZernikeMask}
    return kinds[family](num_masks, generator=generator)
