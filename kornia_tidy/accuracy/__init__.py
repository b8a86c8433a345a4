"""Plans of captures: the cheapest fidelity within an error tolerance, predicted without rendering.

A camera, a scene and a tolerance come in; a plan with its predicted error, operations and memory goes out. Read
``planning/planner.py`` first; the error model is in ``error_model.py``.
"""

from kornia_tidy.accuracy.planning.planner import Planner
from kornia_tidy.accuracy.planning.render_plan import RenderPlan

__all__ = [
    "Planner",
    "RenderPlan",
]
