"""The benchmark of a CUDA card, without one: it refuses, and every line of it runs on the processor."""

from __future__ import annotations

import json

import pytest
import torch

from tests.base import BaseTester
from tests.benchmarks import device as program


class TestDeviceBenchmark(BaseTester):
    @pytest.mark.skipif(torch.cuda.is_available(), reason="a CUDA card is here")
    def test_exception_no_card(self, capsys, tmp_path):
        assert program.main(["-o", str(tmp_path / "device.json")]) == 2
        assert "no CUDA card is here for torch" in capsys.readouterr().err
        assert not any(tmp_path.iterdir())

    def test_feature_what_comes_too_late_is_skipped(self):
        rows = list(program.measured(program.Bench(torch.device("cpu"), quick=True), begin=-program.SECONDS - 1.0))
        assert [row.remark for row in rows] == ["no time was left"] * 4

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
