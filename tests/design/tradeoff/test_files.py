from __future__ import annotations

import json
from dataclasses import asdict, replace

import pytest

from kornia_tidy.design.tradeoff import TradeRun, markdown, write_trade
from tests.base import BaseTester
from tests.design.tradeoff.samples import CONDITIONS, ROW, whole_sweep


class TestWriteTrade(BaseTester):
    def test_feature_json_holds_conditions_and_rows(self, tmp_path):
        run = whole_sweep()
        write_trade(tmp_path, run)
        document = json.loads((tmp_path / "trade.json").read_text())
        assert document["conditions"] == asdict(CONDITIONS)
        assert document["rows"] == [json.loads(json.dumps(asdict(row))) for row in run.rows]

    def test_exception_the_folder_is_missing(self, tmp_path):
        with pytest.raises(FileNotFoundError):
            write_trade(tmp_path / "nowhere", TradeRun(CONDITIONS, (ROW,)))


class TestMarkdown(BaseTester):
    def test_feature_one_line_a_row_and_the_front_is_bold(self):
        slow = replace(ROW, value="reference", rmse=0.0, capture_seconds=2.0, capture_spread=0.1)
        worse = replace(ROW, value="draft", rmse=0.2, capture_seconds=0.5)
        lines = markdown([ROW, slow, worse]).splitlines()
        assert lines[2] == "| preset | **balanced** | 21 | 61 | 0.001 | 0.02 | 250 ± 10 | 200 ± 4 | 3 |"
        assert lines[3].startswith("| preset | **reference** | 21 | 61 | 0 | 0.02 | 2000 ± 100 |")
        assert lines[4].startswith("| preset | draft |")
        assert len({line.count("|") for line in lines}) == 1

    def test_feature_gradients_have_columns_where_they_were_measured(self):
        trained = replace(ROW, training_seconds=0.0042, training_spread=0.0001, training_bytes=2**23)
        lines = markdown([ROW, trained]).splitlines()
        assert "with gradients, ms" in lines[0]
        assert "| 4.2 ± 0.1 | 3 | 8 |" in lines[3]
        assert len({line.count("|") for line in lines}) == 1
