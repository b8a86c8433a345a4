"""kornia_tidy: a differentiable camera with programmable phase masks that change during the exposure."""

from __future__ import annotations

from kornia_tidy.runtime.signals import end_on_signals, is_command

if is_command():
    end_on_signals()  # during the imports that follow, which take seconds

from typing import TYPE_CHECKING, Any

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
from kornia_tidy.sensor.noise import SensorNoise

if TYPE_CHECKING:
    from kornia_tidy.augmentation.arrays import reconstruct, simulate

__version__ = "0.1.0"

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


def __getattr__(name: str) -> Any:
    """Import the functions on arrays when they are first asked for: they need much of the package."""
    if name not in {"reconstruct", "simulate"}:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from kornia_tidy.augmentation import arrays  # noqa: PLC0415

    return getattr(arrays, name)
