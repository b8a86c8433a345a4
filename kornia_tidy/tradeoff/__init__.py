"""The trade between speed and accuracy, measured on the user's own scene and device."""

from kornia_tidy.tradeoff.conditions import Conditions
from kornia_tidy.tradeoff.figure import draw_trade
from kornia_tidy.tradeoff.files import TradeRun, markdown, read_csv, read_json, write_csv, write_json
from kornia_tidy.tradeoff.ladder import LADDERS, PLAN, PRESET, TOLERANCES, Setting, ladder, planned
from kornia_tidy.tradeoff.measure import TradeRow, capture, measure, missing, pareto, sweep

__all__ = [
    "LADDERS",
    "PLAN",
    "PRESET",
    "TOLERANCES",
    "Conditions",
    "Setting",
    "TradeRow",
    "TradeRun",
    "capture",
    "draw_trade",
    "ladder",
    "markdown",
    "measure",
    "missing",
    "pareto",
    "planned",
    "read_csv",
    "read_json",
    "sweep",
    "write_csv",
    "write_json",
]
