"""kornia_tidy: a differentiable camera with programmable phase masks that change during the exposure."""

from kornia_tidy.camera.burst import burst
from kornia_tidy.camera.motion import moving_capture
from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.fidelity import Fidelity
from kornia_tidy.masks.fresnel import FresnelLens
from kornia_tidy.masks.pixelwise import PixelwiseMask
from kornia_tidy.modulator.modulator import DwellTimes, LearnableDwellTimes, SpatialLightModulator
from kornia_tidy.modulator.switching import Switching
from kornia_tidy.optics.spectrum import Spectrum
from kornia_tidy.optics.thin_lens import DefocusRange, ThinLensCamera
from kornia_tidy.psf.psf_bank import PSFBank
from kornia_tidy.sensor.noise import SensorNoise

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
