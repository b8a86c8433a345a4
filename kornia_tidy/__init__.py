"""kornia_tidy: a differentiable camera with programmable phase masks that change during the exposure.

The names below are imported when they are first asked for, so that the help of the command comes at once.
"""

from __future__ import annotations

from kornia_tidy.signals import end_on_signals, is_command

if is_command():
    end_on_signals()  # during the imports that follow, which take seconds

import sys
from typing import TYPE_CHECKING

from kornia_tidy.lazy import importer
from kornia_tidy.moved import MovedModules
from kornia_tidy.version import __version__ as __version__

if TYPE_CHECKING:
    from kornia_tidy.augmentation.arrays import reconstruct, simulate
    from kornia_tidy.camera.burst import burst
    from kornia_tidy.camera.motion import moving_capture
    from kornia_tidy.camera.tidy_optics import TiDyOptics
    from kornia_tidy.fidelity import Fidelity
    from kornia_tidy.masks.fresnel import FresnelLens
    from kornia_tidy.masks.no_mask import NoMask
    from kornia_tidy.masks.pixelwise import PixelwiseMask
    from kornia_tidy.modulator.modulator import DwellTimes, LearnableDwellTimes, SpatialLightModulator
    from kornia_tidy.modulator.switching import Switching
    from kornia_tidy.optics.spectrum import Spectrum
    from kornia_tidy.optics.thin_lens import DefocusRange, ThinLensCamera
    from kornia_tidy.psf.psf_bank import PSFBank
    from kornia_tidy.sensor.sensor import SensorNoise

__all__ = [
    "DefocusRange",
    "DwellTimes",
    "Fidelity",
    "FresnelLens",
    "LearnableDwellTimes",
    "NoMask",
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
    "reconstruct",
    "simulate",
]

__getattr__ = importer(__name__)
sys.meta_path.insert(0, MovedModules())


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
