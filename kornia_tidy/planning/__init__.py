"""The cheapest fidelity that captures a scene within an error, found without capturing it.

A camera, a scene and a tolerance come in; a plan with its predicted error, time and memory goes out. Read
``planner.py`` first; the error model stands in ``error_model.py``.
"""

from kornia_tidy.planning.planner import Planner
from kornia_tidy.planning.render_plan import RenderPlan

__all__ = [
    "Planner",
    "RenderPlan",
]
