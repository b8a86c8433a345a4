"""What shows the masks during the exposure: dwell times, switching, grey levels, crosstalk, diffraction efficiency.

Phase masks come in; the states that the light really meets and their shares of the exposure go out. Read
``modulator.py`` first.
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
