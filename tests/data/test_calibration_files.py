"""Calibration of scenes from their files: Middlebury's text with its odd blanks, and JSON."""

from __future__ import annotations

import pytest

from kornia_tidy.data.calibration_files import read_calibration
from tests.base import BaseTester

# The evaluation sets have blanks where the full ones have none.
TEXT = " cam0=[ 1038.018 0 322.037 ; 0 1038.018 243.393 ; 0 0 1 ] \ncam1=[1 0 2; 0 1 2; 0 0 1]\n doffs= 53.271 \n"
TEXT += "baseline= 176.252\r\n width= 718\nheight= 496\n ndisp= 73\n"


class TestReadCalibration(BaseTester):
    def test_feature_middlebury_in_pixels_and_metres(self, tmp_path):
        (tmp_path / "calib.txt").write_text(TEXT)
        expected = {"focal_px": 1038.018, "baseline_m": 0.176252, "doffs_px": 53.271}
        assert read_calibration(tmp_path / "calib.txt") == pytest.approx(expected)

    def test_feature_json(self, tmp_path):
        (tmp_path / "a.json").write_text('{"focal_px": 500, "scale": 0.001}')
        assert read_calibration(tmp_path / "a.json") == {"focal_px": 500.0, "scale": 0.001}

    @pytest.mark.parametrize(
        ("name", "text", "sentence"),
        [
            ("calib.txt", TEXT.replace("baseline", "base"), "has cam0=.*, baseline= and doffs=, found cam0, "),
            ("calib.txt", TEXT.replace(" 0 0 1 ", " 0 0 "), "Middlebury's calibration has cam0="),
            ("calib.txt", TEXT.replace("176.252", "-176.252"), "baseline_m must be positive and finite, got -0.176"),
            ("calib.txt", TEXT.replace("176.252", "1-2"), "could not convert"),
            ("calib.txt", TEXT.replace("176.252", "176,252"), r"'baseline= 176,252' is no number, with a point"),
            ("calib.txt", TEXT.replace("53.271", "53.271 px").replace("\n", "\r"), "'doffs= 53.271 px' is no number"),
            ("calib.txt", TEXT.replace("53.271", "1e999"), "doffs_px must be positive and finite, got inf"),
            ("a.json", "[1]", "a calibration holds some of focal_px, baseline_m, doffs_px, scale"),
            ("a.json", '{"focal": 1}', "a calibration holds some of focal_px.*got {'focal': 1}"),
            ("calib.txt", TEXT + "\nbaseline=1\n", "it gives an entry twice: .*baseline, .*baseline"),
            ("a.json", '{"scale": "0.001"}', "scale must be a number, got '0.001'"),
            ("a.json", '{"scale": true}', "scale must be a number, got True"),
            ("a.json", '{"scale": 0}', "scale must be positive and finite, got 0"),
        ],
    )
    def test_exception(self, name, text, sentence, tmp_path):
        (tmp_path / name).write_text(text)
        with pytest.raises(ValueError, match=rf"cannot read .*{name}: .*{sentence}"):
            read_calibration(tmp_path / name)
