from __future__ import annotations

import json
from dataclasses import replace

import pytest

from kornia_tidy import Fidelity
from kornia_tidy.design.tradeoff import TradeRun, markdown, read_csv, read_json, write_csv, write_json
from tests.base import BaseTester
from tests.design.tradeoff.samples import CONDITIONS, ROW, whole_sweep


class TestJson(BaseTester):
    def test_feature_comes_back_as_it_was(self, tmp_path):
        write_json(tmp_path / "trade.json", whole_sweep())
        assert read_json(tmp_path / "trade.json") == whole_sweep()

    def test_feature_says_under_what_it_was_measured(self, tmp_path):
        write_json(tmp_path / "trade.json", TradeRun(CONDITIONS, (ROW,)))
        document = json.loads((tmp_path / "trade.json").read_text())
        told = document["conditions"]
        assert {"version", "torch", "device", "threads", "date", "commit", "height", "width", "masks"} <= set(told)
        assert document["rows"][0]["layers"] == 21
        assert document["rows"][0]["training_seconds"] is None

    @pytest.mark.parametrize(
        ("damage", "sentence"),
        [
            (lambda d: d.update(format="kornia_tidy.trade/0"), "its format is 'kornia_tidy.trade/0'"),
            (lambda d: d.pop("conditions"), "the file has no conditions"),
            (lambda d: d["conditions"].pop("torch"), "conditions has no torch"),
            (lambda d: d["conditions"].update(threads="2"), "threads in conditions must be .*int.*, got '2'"),
            (lambda d: d.update(rows={}), "rows must be a list"),
            (lambda d: d["rows"].append(3), "a row must hold .*, got int"),
            (lambda d: d["rows"][0].update(speed=1), "a row has an unknown speed"),
            (lambda d: d["rows"][0].update(rmse=None), "rmse in a row must be .*float.*, got None"),
            (lambda d: d["rows"][0].update(layers=True), "layers in a row must be .*int.*, got True"),
            (lambda d: d["rows"][0]["fidelity"].update(double=1), "double in a row's fidelity must be .*bool.*, got 1"),
            (lambda d: d["rows"][0]["fidelity"].update(layers="best"), "layers must be one of .* got 'best'"),
            (lambda d: d["rows"][0].update(knob="window", value=9), "says window = 9, its fidelity has None"),
        ],
    )
    def test_exception_names_what_is_wrong(self, damage, sentence, tmp_path):
        path = tmp_path / "trade.json"
        write_json(path, TradeRun(CONDITIONS, (ROW,)))
        document = json.loads(path.read_text())
        damage(document)
        path.write_text(json.dumps(document))
        with pytest.raises(ValueError, match=f"trade.json is not a readable sweep: .*{sentence}"):
            read_json(path)

    @pytest.mark.parametrize("data", [b"{", b"[]", b"\xff\xfe\x00"])
    def test_exception_not_a_sweep(self, data, tmp_path):
        (tmp_path / "trade.json").write_bytes(data)
        with pytest.raises(ValueError, match="not a readable sweep"):
            read_json(tmp_path / "trade.json")


class TestCsv(BaseTester):
    def test_feature_comes_back_as_it_was(self, tmp_path):
        rows = [*whole_sweep().rows, replace(ROW, training_seconds=0.1 + 0.2, training_spread=0.0, training_bytes=7)]
        write_csv(tmp_path / "trade.csv", rows)
        assert read_csv(tmp_path / "trade.csv") == rows

    def test_feature_a_name_may_hold_what_separates(self, tmp_path):
        rows = [replace(ROW, fidelity=Fidelity('odd, "very"\nodd'))]
        write_csv(tmp_path / "trade.csv", rows)
        assert read_csv(tmp_path / "trade.csv") == rows

    @pytest.mark.parametrize(
        ("old", "new", "sentence"),
        [
            ("rmse", "error", "the header has an unknown error, no rmse"),
            (",61,", ",many,", "invalid literal for int"),
            (",False,", ",no,", "expected True or False, got 'no'"),
        ],
    )
    def test_exception_names_what_is_wrong(self, old, new, sentence, tmp_path):
        path = tmp_path / "trade.csv"
        write_csv(path, [ROW])
        path.write_text(path.read_text().replace(old, new))
        with pytest.raises(ValueError, match=f"trade.csv is not a readable sweep: .*{sentence}"):
            read_csv(path)


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
