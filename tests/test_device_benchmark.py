"""The benchmark of a CUDA card, without one: it refuses, and every line of it runs on the processor."""

from __future__ import annotations

import json

import pytest

from tests.base import BaseTester
from tests.benchmarks import device as program


class TestDeviceBenchmark(BaseTester):
    @pytest.mark.slow
    def test_smoke_every_line_on_the_processor(self, tmp_path):
        path = tmp_path / "device.json"
        assert program.main(["--device", "cpu", "--quick", "-o", str(path)]) == 0
        written = json.loads(path.read_text())
        assert written["card"] == "none: the processor"
        assert {"date", "commit", "torch", "seconds"} <= written.keys()
        rows = written["rows"]
        assert {row["section"] for row in rows} == {"right", "rendering", "training", "restoration"}
        assert all(row["value"] is not None or "cannot be imported" in row["remark"] for row in rows)
        assert sum(row["right"] is True for row in rows) >= 14
