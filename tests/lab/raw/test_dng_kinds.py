from __future__ import annotations

import sys

import pytest

from tests.base import BaseTester
from tests.lab.raw.dng_kinds import CONTRADICTIONS, count

FAST = 25

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="files are passed on through /proc")


class TestKinds(BaseTester):
    """Filter arrays, corners, levels and samples of DNGs in any combination, against the arrays that were written."""

    @pytest.mark.parametrize(("first", "last"), [(0, FAST), pytest.param(FAST, 1000, marks=pytest.mark.slow)])
    def test_feature_read_right_to_half_a_count_or_refused(self, first, last):
        outcomes = count(first, last)
        assert outcomes["WRONG"] == 0
        assert outcomes["read right"] >= 0.8 * (last - first)
        assert len(outcomes) == 1 + len(CONTRADICTIONS) or last <= FAST
