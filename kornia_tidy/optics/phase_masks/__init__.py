"""Phase masks: height maps of an optical element in the pupil, one for each state shown during the exposure."""

from kornia_tidy.optics.phase_masks.base import (
    MASK_SPAN,
    PhaseMasks,
    adam_groups,
    central_square,
    mask_axes,
    mask_coordinates,
    metres_to_radians,
)
from kornia_tidy.optics.phase_masks.cubic import CubicMask
from kornia_tidy.optics.phase_masks.fourier import FourierMask
from kornia_tidy.optics.phase_masks.fresnel import FresnelLens
from kornia_tidy.optics.phase_masks.pixelwise import PixelwiseMask
from kornia_tidy.optics.phase_masks.radial import RadialMask
from kornia_tidy.optics.phase_masks.spiral import SpiralMask
from kornia_tidy.optics.phase_masks.zernike import ZernikeMask

__all__ = [
    "MASK_SPAN",
    "CubicMask",
    "FourierMask",
    "FresnelLens",
    "PhaseMasks",
    "PixelwiseMask",
    "RadialMask",
    "SpiralMask",
    "ZernikeMask",
    "adam_groups",
    "central_square",
    "mask_axes",
    "mask_coordinates",
    "metres_to_radians",
]
