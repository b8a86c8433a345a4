"""Records of training runs: what evaluation and validation wrote, and what is damaged."""

from __future__ import annotations

import pytest

from kornia_tidy.training.evaluation import write_table
from kornia_tidy.training.record import training_record
from tests.base import BaseTester


class TestTrainingRecord(BaseTester):
    def test_feature_scores_of_an_evaluation(self, tmp_path):
        (tmp_path / "evaluation").mkdir()
        rows = [{"scene": i, "name": "x", "image_psnr": value} for i, value in enumerate((20.0, 23.0))]
        write_table(tmp_path / "evaluation", rows, {"split": "test", "settings": {"data": "nyu"}})
        assert training_record(tmp_path) == {"scores": {"nyu, test, 2 scenes": {"image_psnr": 21.5}}}

    @pytest.mark.parametrize("text", ["5", "{}", '{"mean": 1, "settings": {"data": 1}, "split": 1, "scenes": 1}', "{"])
    def test_exception_a_damaged_summary(self, text, tmp_path):
        (tmp_path / "evaluation").mkdir()
        (tmp_path / "evaluation" / "summary.json").write_text(text)
        with pytest.raises(ValueError, match=r"cannot read .*summary\.json"):
            training_record(tmp_path)

    def test_exception_a_damaged_validation(self, tmp_path):
        (tmp_path / "validation.csv").write_bytes(b"epoch\n\xff\n")
        with pytest.raises(ValueError, match=r"cannot read .*validation\.csv"):
            training_record(tmp_path)

    def test_exception_no_run(self, tmp_path):
        with pytest.raises(FileNotFoundError, match="it is no folder of a run"):
            training_record(tmp_path)
        with pytest.raises(FileNotFoundError, match="there is no folder"):
            training_record(tmp_path / "a")
