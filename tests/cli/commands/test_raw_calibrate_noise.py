from __future__ import annotations

import numpy as np
import pytest

from kornia_tidy.cli import main
from kornia_tidy.lab.calibration.noise.photon_transfer import read_json
from kornia_tidy.lab.raw import RawInfo
from kornia_tidy.lab.raw.dng_writer import write_dng
from tests.base import BaseTester
from tests.lab.calibration.noise.flats import flats

INFO = RawInfo("Acme", "One", iso=800.0)


@pytest.fixture
def shots(tmp_path, monkeypatch):
    """Two dark captures and pairs at three levels: 2 electrons a count, 6 electrons of read noise."""
    monkeypatch.chdir(tmp_path)
    levels = (0.0, 0.0, 0.05, 0.05, 0.2, 0.2, 0.6, 0.6)
    for k, raw in enumerate(flats(np.random.default_rng(0), 2.0, 6.0, levels, info=INFO)):
        write_dng(f"{k}.dng", raw)
    return tmp_path


class TestCalibrateNoise(BaseTester):
    def test_smoke_from_files_to_a_sensor(self, shots, capsys):
        files = [f"{k}.dng" for k in range(2, 8)]
        assert main(["raw", "calibrate-noise", *files, "--dark", "0.dng", "1.dng", "-o", "n.json"]) == 0
        told = capsys.readouterr()
        assert told.err == ""
        for word in ("Acme One, ISO 800", "electrons a count", "a straight line", "n.json and n.png"):
            assert word in told.out
        result = read_json("n.json")
        assert result.line.gain == pytest.approx(2.0, rel=0.03)
        assert result.line.read_noise == pytest.approx(6.0, rel=0.03)
        assert result.black == pytest.approx(256, abs=0.1)
        assert (shots / "n.png").read_bytes()[:4] == b"\x89PNG"

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (["2.dng", "-o", "none/n.json"], "there is no folder none"),
            (["2.dng", "-o", "2.dng"], "cannot write 2.dng: it is an input"),
            (["2.dng", "./2.dng", "-o", "n.json"], "./2.dng is given twice, and each capture counts once"),
            (["2.dng", "-o", "n.json", "--plot", "n.bmp"], "the suffix of a plot must be one of '.png'"),
            (["2.dng", "missing.dng", "-o", "n.json"], "missing.dng"),
            (["2.dng", "4.dng", "-o", "n.json"], "every exposure needs two captures or more"),
            (["2.dng", "-o", "n.json"], "the picture"),
        ],
    )
    def test_exception_is_one_sentence_and_nothing_is_written(self, shots, refused, arguments, message):
        assert message in refused(["raw", "calibrate-noise", *arguments])
        assert not {"n.json", "n.png", "n.bmp"} & {path.name for path in shots.iterdir()}
