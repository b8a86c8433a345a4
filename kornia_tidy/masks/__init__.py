"""Phase masks: families of height maps in the pupil, their limits, and the heights that they start from.

The parameters of a family go in; phases in radians at 530 nm and heights in metres come out, one map for each state of
the exposure. Read ``base.py`` first, then any family.
"""

from kornia_tidy.masks.base import (
    MASK_SPAN,
    PhaseMasks,
    adam_groups,
    central_square,
    mask_axes,
    mask_coordinates,
    metres_to_radians,
)
from kornia_tidy.masks.cubic import CubicMask
from kornia_tidy.masks.fourier import FourierMask
from kornia_tidy.masks.fresnel import FresnelLens
from kornia_tidy.masks.initial_heights import fisher_mask, initial_heights
from kornia_tidy.masks.no_mask import NoMask
from kornia_tidy.masks.pixelwise import PixelwiseMask
from kornia_tidy.masks.radial import RadialMask
from kornia_tidy.masks.spiral import SpiralMask
from kornia_tidy.masks.zernike import ZernikeMask

__all__ = [
    "MASK_SPAN",
    "CubicMask",
    "FourierMask",
    "FresnelLens",
    "NoMask",
    "PhaseMasks",
    "PixelwiseMask",
    "RadialMask",
    "SpiralMask",
    "ZernikeMask",
    "adam_groups",
    "central_square",
    "fisher_mask",
    "initial_heights",
    "mask_axes",
    "mask_coordinates",
    "metres_to_radians",
]
