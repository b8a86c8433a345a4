"""The rows of docs/record/extremes.md."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from tests.extremes.devices import TF32Device, tf32
from tests.extremes.row import Row
from tests.extremes.table import all_rows, measure

ROWS = all_rows()
PAGE = Path(__file__).parents[2] / "docs" / "record" / "extremes.md"


class TestExtremes:
    @pytest.mark.takes_seconds
    @pytest.mark.parametrize(
        "row", [pytest.param(row, id=row.name, marks=[pytest.mark.slow] if row.slow else []) for row in ROWS]
    )
    def test_feature_row(self, row: Row):
        if row.absent:
            pytest.skip(row.absent)
        measure(row)

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


class TestTF32:
    def test_feature_ten_bits_are_left_and_ties_go_to_even(self):
        values = torch.tensor([1 + 2**-12, 1 + 2**-11, 1 + 3 * 2**-11, -1 - 2**-10, 0.0])
        assert tf32(values).tolist() == [1.0, 1.0, 1 + 2**-9, -1 - 2**-10, 0.0]
        assert torch.equal(tf32(torch.complex(values, -values)), torch.complex(tf32(values), -tf32(values)))
        assert torch.equal(tf32(values.double()), values.double())

    def test_feature_products_on_the_simulated_device_are_rounded(self):
        """Else the tests of what is not rounded would show nothing."""
        matrix = torch.rand(8, 8, generator=torch.Generator().manual_seed(0))
        with TF32Device() as device:
            there = device.put(matrix)
            found = (there @ there).on_cpu
        assert torch.equal(found, tf32(matrix) @ tf32(matrix))
        assert not torch.equal(found, matrix @ matrix)
