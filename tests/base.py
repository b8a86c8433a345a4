"""What every test class shares: comparisons with a tolerance that follows the data type, and gradient checks."""

from __future__ import annotations

import importlib.util
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from torch import Tensor

SHARED = Path(__file__).resolve().parents[2] / "shared"
DATA = SHARED / "data"

needs_data = pytest.mark.skipif(not DATA.is_dir(), reason="../shared/data is not on this machine")


def shared(part: str, counts: dict[str, int] | None = None) -> Path:
    """Return a file or folder of ../shared; skips the test, by name, where it is not on this machine.

    Args:
        part: path from ../shared, such as ``data/scenes.json``.
        counts: for a folder, how many files of each pattern must be in it.
    """
    path = SHARED / part
    if not path.exists():
        pytest.skip(f"../shared/{part} is not on this machine")
    for pattern, count in (counts or {}).items():
        if (found := len(list(path.glob(pattern)))) < count:
            pytest.skip(f"../shared/{part} has {found} of {count} files {pattern} on this machine")
    return path


@cache
def oracle() -> ModuleType:
    """Return the independent model, ../shared/oracle/oracle.py; skips the test where it is not on this machine."""
    spec = importlib.util.spec_from_file_location("oracle", shared("oracle/oracle.py"))
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


TOLERANCES = {
    torch.bfloat16: (7.8e-3, 7.8e-3),
    torch.float16: (1e-3, 1e-3),
    torch.float32: (1e-4, 1e-5),
    torch.float64: (1e-5, 1e-5),
}


class BaseTester:
    """Base class of test classes. Kinds: smoke, exception, cardinality, feature, gradcheck, dynamo."""

    @staticmethod
    def assert_close(actual: Tensor, expected: Tensor, rtol: float | None = None, atol: float | None = None) -> None:
        """Compare with the looser tolerance of the two data types, or the given one."""
        pairs = [TOLERANCES[t.dtype] for t in (actual, expected) if t.dtype in TOLERANCES] or [(0.0, 0.0)]
        rtol = max(p[0] for p in pairs) if rtol is None else rtol
        atol = max(p[1] for p in pairs) if atol is None else atol
        torch.testing.assert_close(actual, expected, rtol=rtol, atol=atol, check_dtype=False)

    @staticmethod
    def gradcheck(function: Any, inputs: tuple[Any, ...], **options: Any) -> None:
        """Check gradients in float64 of every floating-point input."""
        prepared = tuple(
            x.detach().double().requires_grad_() if isinstance(x, Tensor) and x.is_floating_point() else x
            for x in inputs
        )
        assert torch.autograd.gradcheck(function, prepared, **{"fast_mode": True, **options})
