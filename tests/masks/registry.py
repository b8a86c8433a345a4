"""Families of masks that the tests of all families take, each told by its own test file ``test_<family>.py``.

A test file says in ``ONE_MASK`` which single masks the fidelity presets must propagate accurately, made with a
generator; and in ``TWO_MASKS``, if the family learns, how two masks are made, with options passed on. ``OVER_PUPIL``
says that the family's shapes are given over the pupil, whatever the size of the mask.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from pathlib import Path

import torch

from kornia_tidy.masks import PhaseMasks

TWO_MASKS: dict[str, Callable[..., PhaseMasks]] = {}
ONE_MASK: dict[str, Callable[[torch.Generator], PhaseMasks]] = {}
OVER_PUPIL: list[str] = []
for _file in sorted(Path(__file__).parent.glob("test_*.py")):
    if "ONE_MASK = " in _file.read_text():
        _module = importlib.import_module(f"tests.masks.{_file.stem}")
        TWO_MASKS.update(getattr(_module, "TWO_MASKS", {}))
        ONE_MASK.update(_module.ONE_MASK)
        OVER_PUPIL += _module.TWO_MASKS if getattr(_module, "OVER_PUPIL", False) else []
