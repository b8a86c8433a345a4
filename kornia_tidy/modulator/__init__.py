"""Modulators: devices that show phase masks in sequence during one exposure, with their imperfections.

Phase masks come in. The phase states that the device really shows, transitions included, and their fractions of the
exposure go out. ``modulator.py`` has dwell times and diffraction efficiency, ``switching.py`` the transitions between
masks, ``phase_panel.py`` grey levels, phase gain and crosstalk. Read ``modulator.py`` first.
"""

from kornia_tidy.modulator.modulator import (
    DiffractionEfficiency,
    DwellTimes,
    LearnableDwellTimes,
    SpatialLightModulator,
)
from kornia_tidy.modulator.phase_panel import GreyLevels, PixelCrosstalk, StrokeError
from kornia_tidy.modulator.switching import Switching

__all__ = [
    "DiffractionEfficiency",
    "DwellTimes",
    "GreyLevels",
    "LearnableDwellTimes",
    "PixelCrosstalk",
    "SpatialLightModulator",
    "StrokeError",
    "Switching",
]
