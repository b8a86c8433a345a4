"""The rows of docs/extremes.md: the quick ones in every run, the others with --runslow."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.extremes.row import Row
from tests.extremes.table import all_rows, measure

ROWS = all_rows()
PAGE = Path(__file__).parents[2] / "docs" / "extremes.md"


class TestExtremes:
    @pytest.mark.parametrize(
        "row", [pytest.param(row, id=row.name, marks=[pytest.mark.slow] if row.slow else []) for row in ROWS]
    )
    def test_feature_row(self, row: Row):
        if row.absent:
            pytest.skip(row.absent)
        measure(row)

    def test_feature_names_are_unique(self):
        assert len({row.name for row in ROWS}) == len(ROWS)

    def test_feature_the_page_has_every_row(self):
        lines = PAGE.read_text(encoding="utf-8").splitlines()
        for row in ROWS:
            assert any(line.startswith(f"| {row.quantity} | {row.tried} |") for line in lines), row.name

    def test_exception_a_row_beyond_its_bound(self):
        with pytest.raises(AssertionError, match="error 2, allowed 1"):
            measure(Row("a", "b", "c", lambda: 2.0, 1.0))
        with pytest.raises(AssertionError, match="NaN or infinity"):
            measure(Row("a", "b", "c", lambda: float("nan"), 1.0))
        with pytest.raises(AssertionError, match="not refused"):
            measure(Row("a", "b", "c", lambda: 0.0, None))
