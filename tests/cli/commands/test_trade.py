from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch

from kornia_tidy.cli import main
from kornia_tidy.data import read_image, write_depth, write_image
from kornia_tidy.design.tradeoff import TOLERANCES
from kornia_tidy.design.tradeoff import sweep as real_sweep
from kornia_tidy.fidelity import LAYERS
from tests.base import BaseTester
from tests.design.tradeoff.samples import ROW

QUICK = ["--size", "48", "--masks", "2", "--repeats", "1", "--base", "paper", "--reference", "paper"]
KNOBS = ["--knobs", "layer_spacing"]


@pytest.fixture
def measured(monkeypatch):
    """Replace measurements by invented rows, and return the list of measured spacings in order."""
    settings = []

    def made_up(optics, image, depth, fidelity, *_, repeats, training):
        settings.append(fidelity.layer_spacing)
        return replace(ROW, fidelity=fidelity, repeats=repeats)

    monkeypatch.setitem(real_sweep.__globals__, "measure", made_up)
    return settings


class TestTrade(BaseTester):
    @pytest.mark.takes_seconds
    def test_feature_writes_table_files_and_picture(self, tmp_path, capsys):
        folder = tmp_path / "new" / "trade"
        assert main(["trade", *QUICK, "--knobs", "layers", "--training", "-o", str(folder)]) == 0
        told = capsys.readouterr().out
        run = json.loads((folder / "trade.json").read_text())
        assert [row["value"] for row in run["rows"]] == list(LAYERS)
        assert run["conditions"]["reference"] == "paper"
        assert [row["rmse"] == 0 for row in run["rows"]] == [mode == "nearest" for mode in LAYERS]
        assert all(row["training_seconds"] > 0 for row in run["rows"])
        assert told.count("| layers | ") == len(LAYERS) + 1  # and the column of that name
        assert read_image(folder / "trade.png").shape == (3, 930, 1500)
        assert {p.name for p in folder.iterdir()} == {"trade.json", "trade.png"}
        assert all(str(path) in told for path in folder.iterdir())

    @pytest.mark.filterwarnings("default")
    def test_feature_other_units_are_told(self, tmp_path, capsys, measured):
        write_image(tmp_path / "image.png", torch.rand(3, 48, 48))
        write_depth(tmp_path / "depth.png", torch.full((1, 48, 48), 1.1), 0.001)
        files = ["--image", str(tmp_path / "image.png"), "--depth", str(tmp_path / "depth.png")]
        assert main(["trade", *QUICK[2:], *KNOBS, *files, "-o", str(tmp_path / "new")]) == 0
        told = [line for line in capsys.readouterr().err.splitlines() if "millimetres" in line]
        assert len(told) == 1
        assert told[0].startswith("kornia-tidy: warning: the nearest pixel is 1100 m away")

    @pytest.mark.takes_seconds
    @pytest.mark.usefixtures("measured")
    def test_feature_plans_are_measured_too_and_windows_fit_the_image(self, tmp_path):
        assert main(["trade", *QUICK, "--knobs", "plan", "window", "-o", str(tmp_path)]) == 0
        rows = json.loads((tmp_path / "trade.json").read_text())["rows"]
        assert [row["value"] for row in rows if row["knob"] == "plan"] == list(TOLERANCES)
        assert max(row["fidelity"]["window"] for row in rows if row["knob"] == "plan") == 95
        assert [row["value"] for row in rows if row["knob"] == "window"] == [9, 17, 33, 65, None]

    @pytest.mark.usefixtures("measured")
    def test_feature_a_scene_of_ones_own(self, tmp_path, capsys):
        write_image(tmp_path / "image.png", torch.rand(1, 48, 56))
        write_depth(tmp_path / "depth.pfm", torch.linspace(3, 6, 48 * 56).view(1, 48, 56))
        files = ["--image", str(tmp_path / "image.png"), "--depth", str(tmp_path / "depth.pfm"), "--fit-depth"]
        assert main(["trade", *QUICK, "--knobs", "layers", *files, "-o", str(tmp_path / "out")]) == 0
        told = json.loads((tmp_path / "out" / "trade.json").read_text())["conditions"]
        assert [told[name] for name in ("scene", "height", "width", "channels")] == ["image.png", 48, 56, 1]
        assert "(psi +20.00 to -20.00)" in capsys.readouterr().out

    @pytest.mark.parametrize(
        ("arguments", "sentence"),
        [
            (["--image", "a.png"], "--image and --depth belong together"),
            (["--device", "tpu"], "device must be one of 'cpu', 'cuda', got 'tpu'"),
            (["--device", "cpu:x"], "device must be cpu, cuda or cuda:N, got 'cpu:x'"),
        ],
    )
    def test_exception_is_one_sentence_before_any_work(self, arguments, sentence, tmp_path, monkeypatch, refused):
        monkeypatch.chdir(tmp_path)
        assert sentence in refused(["trade", *arguments])
        assert list(tmp_path.iterdir()) == []
