"""What the run as other machines promises: skipped factors are said, and a failure is not lost."""

from __future__ import annotations

import re

import pytest

from tests import portable
from tests.base import BaseTester
from tests.portable import FACTORS, Factor, Machine

PLAIN = Machine("a processor", portable.V2, {"aten": "DEFAULT", "mkl": "0"})
USED = {"aten": "DEFAULT", "mkl": "1", "compiled": True, "threads": 1}


@pytest.fixture
def probed(monkeypatch):
    """Replace the probe by a fixed answer, so that no process is started."""
    used = dict(USED)
    monkeypatch.setattr(portable, "probe", lambda environment: used)
    monkeypatch.setattr(portable, "this_machine", lambda: PLAIN)
    return used


def factor(name: str) -> Factor:
    return next(f for f in FACTORS if f.name == name)


class TestPortable(BaseTester):
    def test_feature_every_test_that_is_named_is_there(self):
        assert all((portable.ROOT / path).exists() for f in FACTORS for path in (*f.tests, *f.quick))
        assert len({f.name for f in FACTORS}) == len(FACTORS)

    @pytest.mark.usefixtures("probed")
    @pytest.mark.parametrize(
        ("name", "reason"),
        [
            ("aten avx2", r"this processor \(a processor\) has no abm, avx2, "),
            ("c x86-64-v3", r"this processor \(a processor\) has no abm, avx2, "),
            ("c native clang", "clang is not on this machine"),
            ("threads 2", "PyTorch uses 1 threads"),
            ("c no compiler", "the C sources are compiled nevertheless"),
            ("onemkl compatible", None),
        ],
    )
    def test_feature_what_cannot_be_had_is_said(self, name, reason, monkeypatch):
        monkeypatch.setattr(portable.shutil, "which", lambda program: None)
        outcome = portable.why_not(factor(name), PLAIN)
        assert (outcome is None) == (reason is None)
        if reason:
            assert re.search(reason, str(outcome))
