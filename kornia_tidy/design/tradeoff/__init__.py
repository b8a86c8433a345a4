"""Measurement of the speed-accuracy trade-off on the user's own scene and device.

A camera and a scene with depth come in; rows of time, memory and error for each setting go out. Read ``measure.py``
first; ``sweep_settings.py`` has the settings that are swept.
"""

from kornia_tidy.design.tradeoff.conditions import Conditions
from kornia_tidy.design.tradeoff.files import TradeRun, markdown, write_trade
from kornia_tidy.design.tradeoff.measure import TradeRow, capture, measure, pareto, sweep
from kornia_tidy.design.tradeoff.sweep_settings import (
    PLAN,
    PRESET,
    SWEEP_VALUES,
    TOLERANCES,
    Setting,
    planned,
    sweep_settings,
)

__all__ = [
    "PLAN",
    "PRESET",
    "SWEEP_VALUES",
    "TOLERANCES",
    "Conditions",
    "Setting",
    "TradeRow",
    "TradeRun",
    "capture",
    "markdown",
    "measure",
    "pareto",
    "planned",
    "sweep",
    "sweep_settings",
    "write_trade",
]
