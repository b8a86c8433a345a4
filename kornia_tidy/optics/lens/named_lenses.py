"""Prescriptions of four lenses as published, in millimetres, with the source of each, in ``named_lenses.json``."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

NAMED_LENSES: dict[str, dict[str, Any]] = json.loads(Path(__file__).with_suffix(".json").read_text("utf-8"))
"""Lenses by name: prescription, and largest height on the sensor in metres unless another is asked for."""
