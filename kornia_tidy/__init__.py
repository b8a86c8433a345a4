"""kornia_tidy: a programmable camera, with masks that change during the exposure, in front of any PyTorch pipeline."""

from kornia_tidy.fidelity import Fidelity
from kornia_tidy.motion import moving_capture
from kornia_tidy.multi_shot import burst
from kornia_tidy.optics.camera import DefocusRange, ThinLensCamera
from kornia_tidy.optics.modulator import DwellTimes, LearnableDwellTimes, SpatialLightModulator
from kornia_tidy.optics.phase_masks import FresnelLens, PixelwiseMask
from kornia_tidy.optics.psf_bank import PSFBank
from kornia_tidy.optics.spectrum import Spectrum
from kornia_tidy.optics.switching import Switching
from kornia_tidy.sensor.noise import SensorNoise
from kornia_tidy.tidy_optics import TiDyOptics

__version__ = "0.1.0"

__all__ = [
    "DefocusRange",
    "DwellTimes",
    "Fidelity",
    "FresnelLens",
    "LearnableDwellTimes",
    "PSFBank",
    "PixelwiseMask",
    "SensorNoise",
    "SpatialLightModulator",
    "Spectrum",
    "Switching",
    "ThinLensCamera",
    "TiDyOptics",
    "burst",
    "moving_capture",
]
