"""A sample of the damaged lenses of `python -m tests.optics.lens.mutate`."""

from __future__ import annotations

import pytest

from tests.base import BaseTester
from tests.optics.lens.mutate import outcome


class TestMutate(BaseTester):
    @pytest.mark.parametrize("first", range(0, 60, 20))
    def test_exception_damaged_lenses_are_taken_or_refused_in_a_sentence(self, first, tmp_path):
        taken = [outcome(seed, tmp_path) for seed in range(first, first + 20)]
        assert [said for result, said in taken if result == "failed"] == []
        assert {result for result, _ in taken} == {"accepted", "refused"}
