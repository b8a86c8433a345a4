from __future__ import annotations

import json

import pytest
import torch

from kornia_tidy import DwellTimes, SpatialLightModulator, Switching
from kornia_tidy.cli import main
from kornia_tidy.cli.command_line import read_command
from kornia_tidy.data import read_image, write_depth, write_image
from kornia_tidy.data.rgbd_folder import scenes_in
from kornia_tidy.design import Effort
from tests.base import BaseTester

TINY = Effort(coarse_steps=1, steps=1, starts=("focal sweep",), scenes=4, size=97)
DIM = ["--quick", "--masks", "1", "--electrons", "60"]
FILES = {"report.json", "design.png", "masks.npy", "camera.safetensors"}


def parsed(arguments):
    """Return the task of a command line."""
    return read_command(["design", *arguments]).task()


class TestDesign(BaseTester):
    @pytest.mark.takes_seconds
    def test_feature_writes_all_files_and_says_the_verdict(self, tmp_path, capsys, monkeypatch):
        monkeypatch.setattr(Effort, "quick", lambda: TINY)
        folder = tmp_path / "out"
        assert main(["design", *DIM, "-o", str(folder)]) == 0
        lines = capsys.readouterr().out.splitlines()
        assert {path.name for path in folder.iterdir()} == FILES
        words = json.loads((folder / "report.json").read_text())["words"]
        assert [line.split()[0] for line in lines[:6]] == ["scene", "light", "work", "verdict", "exposure", "camera"]
        assert lines[3].endswith(words)
        assert read_image(folder / "design.png").shape[2] > 1500

    def test_feature_options_reach_the_task(self):
        task = parsed(["--depth-range", "0.5", "4", "--bits", "6", "--switching-time", "4e-3", "--exposure", "0.05"])
        assert task.depth_range == (0.5, 4.0)
        assert isinstance(task.modulator, SpatialLightModulator)
        levels, switching = task.modulator.parts
        assert (levels.bits, switching.switching_time, switching.exposure) == (6, 4e-3, 0.05)
        assert isinstance(parsed(["--switching-time", "4e-3"]).modulator, Switching)
        assert isinstance(parsed([]).modulator, DwellTimes)
        assert (parsed([]).mask_size, parsed(["--mask-size", "92"]).mask_size) == (23, 92)

    def test_feature_scenes_of_ones_own(self, tmp_path):
        write_image(tmp_path / "a.png", torch.rand(3, 100, 600))
        write_depth(tmp_path / "a_depth.png", torch.full((1, 100, 600), 1.5), scale=0.001)
        (tmp_path / "rgbd.json").write_text('{"image": "*.png", "depth": "*_depth.png", "scale": 0.001}')
        (scene,) = scenes_in(tmp_path)
        assert scene.image.shape == (3, 100, 512)
        assert scene.depth.unique().tolist() == pytest.approx([1.5])

    @pytest.mark.parametrize(
        ("arguments", "sentence"),
        [
            (["--focal-length", "50"], "focal_length must be metres between 1e-05 and 10 (50 mm is 50e-3), got 50.0"),
            (["--depth-range", "300", "5000"], "if they are millimetres, multiply them by 0.001"),
            (["--switching-time", "4"], "transitions of 4000 ms must fit into the exposure of 100 ms"),
            (["--bits", "11"], "bits must be a whole number from 1 to 10, got 11"),
            (["--scenes", "nowhere"], "rgbd.json"),
        ],
    )
    def test_exception_in_one_sentence_before_anything_is_written(self, arguments, sentence, tmp_path, refused):
        folder = tmp_path / "out"
        assert sentence in refused(["design", *arguments, "-o", str(folder)])
        assert not folder.exists()

    def test_exception_the_output_is_a_file(self, tmp_path, refused):
        (tmp_path / "out").write_text("")
        assert "it is not a folder" in refused(["design", "-o", str(tmp_path / "out")])
