from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
import torch

from kornia_tidy.cli import main
from kornia_tidy.data import write_depth, write_image
from kornia_tidy.reconstruction.state_file import write_state
from kornia_tidy.reconstruction.trained import build_head, build_optics
from kornia_tidy.training.coded_datasets import CodedCaptures
from kornia_tidy.training.settings import TrainingSettings
from tests.base import BaseTester
from tests.training.coded_datasets.samples import contents

ROOT = Path(__file__).resolve().parents[3]
SMALL = ["--size", "40", "--scenes", "3", "--fidelity", "draft", "--border", "replicate", "--depth-range", "0.4", "4"]
RENDER = ["render", *SMALL, "--masks", "2", "--shard-items", "2"]


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rendered")
    assert main([*RENDER, "-o", str(folder)]) == 0
    return folder


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    """Write a trained system with masks other than the initial ones of its settings."""
    settings = TrainingSettings(masks=1, size=40, width=4, head="plain", window=23, border="replicate", seed=3)
    optics, head = build_optics(settings), build_head(settings)
    with torch.no_grad():
        optics.masks.phase.mul_(0.5)
    weights = {f"optics.{name}": value for name, value in optics.state_dict().items()}
    weights |= {f"head.{name}": value for name, value in head.state_dict().items()}
    path = tmp_path_factory.mktemp("run") / "best.safetensors"
    write_state(path, {"settings": settings.as_dict(), "global_step": 4, "state_dict": weights})
    return path, optics


class TestRender(BaseTester):
    def test_feature_the_summary_tells_numbers_and_a_second_call_finds_all(self, rendered, capsys):
        assert main([*RENDER, "-o", str(rendered)]) == 0
        out = capsys.readouterr().out
        assert re.search(r"wrote +.*: 0 captures in [\d.]+ s, 0.00 a second, 3 were there", out)
        assert "3 of 'photographic-leaves', train" in out
        assert sorted(path.name for path in rendered.iterdir()) == [
            "00000.tar",
            "00001.tar",
            "index.csv",
            "render.json",
        ]
        capture = CodedCaptures(rendered)[2]
        assert capture["coded"].shape == (3, 40, 40)
        assert 0.4 <= capture["depth"].min() <= capture["depth"].max() <= 4

    @pytest.mark.parametrize("names", [("RANK", "WORLD_SIZE"), ("SLURM_PROCID", "SLURM_NTASKS")])
    def test_feature_ranks_of_the_environment_share_the_work(self, names, rendered, tmp_path, monkeypatch, capsys):
        """The first call takes the share of the second one over, as that has not begun."""
        monkeypatch.setenv(names[1], "2")
        for rank, made in (("1", "3 captures"), ("0", "0 captures")):
            monkeypatch.setenv(names[0], rank)
            assert main([*RENDER, "-o", str(tmp_path)]) == 0
            assert f"process {int(rank) + 1} of 2: {made}" in capsys.readouterr().out
        assert contents(tmp_path) == contents(rendered)

    def test_feature_a_trained_camera_photographs_scenes_of_its_training(self, checkpoint, tmp_path):
        path, optics = checkpoint
        command = ["render", "--checkpoint", str(path), "--split", "test", "--scenes", "2", "--beside", "depth"]
        assert main([*command, "-o", str(tmp_path)]) == 0
        about = json.loads((tmp_path / "render.json").read_text())
        assert torch.equal(torch.tensor(about["heights_m"]), optics.masks.heights())
        assert (about["made_from"]["scenes"]["seed"], about["made_from"]["split"]) == (3, "test")
        assert set(CodedCaptures(tmp_path)[1]) == {"coded", "depth", "index", "name"}

    @pytest.mark.filterwarnings("ignore:the paper's 23x23 pupil:UserWarning")
    def test_feature_a_published_camera_sees_scenes_of_its_own_depths(self, tmp_path):
        command = ["render", "--preset", "ikoma2021", "--size", "64", "--scenes", "1", "--border", "replicate"]
        assert main([*command, "--compositing", "gather", "--fidelity", "draft", "-o", str(tmp_path)]) == 0
        about = json.loads((tmp_path / "render.json").read_text())
        assert about["made_from"]["preset"] == "ikoma2021"
        assert about["made_from"]["scenes"]["depth_range"] == about["camera"]["depth_range"]
        assert about["compositing"] == "gather"

    def test_feature_a_folder_of_photographs(self, tmp_path):
        for name in "ab":
            write_image(tmp_path / f"{name}.png", torch.rand(3, 50, 60))
            write_depth(tmp_path / f"{name}_depth.png", torch.full((1, 50, 60), 1.25), scale=0.001)
        (tmp_path / "rgbd.json").write_text('{"image": "*.png", "depth": "*_depth.png", "scale": 0.001}')
        small = ["--size", "48", "--fidelity", "draft", "--border", "replicate", "--masks", "1", "--float"]
        folder = ["--data", "rgbd-folder", "--root", str(tmp_path), "--split", "all"]
        assert main(["render", *folder, *small, "-o", str(tmp_path / "out")]) == 0
        captures = CodedCaptures(tmp_path / "out")
        assert [captures.name(i) for i in range(len(captures))] == ["a", "b"]
        assert captures[1]["depth"].unique().tolist() == [1.25]
        assert (tmp_path / "out" / "000001" / "coded.npy").exists()

    @pytest.mark.parametrize(
        ("options", "sentence"),
        [
            (["--data", "rgbd-folder", "--root", "nowhere"], "there is no nowhere"),
            (["--preset", "tidy-5", "--masks", "3"], "--masks does not go with --preset, which has its own"),
            (["--checkpoint", "none.safetensors"], "cannot read none.safetensors: there is no such file"),
            (["--checkpoint", "a", "--focal-length", "0.1"], "--focal-length does not go with --checkpoint"),
            (["--shard-items", "1", "--shard-megabytes", "1"], "--shard-items and --shard-megabytes say the same"),
            (["--preset", "tidy-5", "--checkpoint", "a"], "--preset and --checkpoint are two cameras"),
            (["--jobs", "0"], "jobs must be 1 or more"),
            (["--split", "all"], "split must be one of 'train', 'validation', 'test', got 'all'"),
        ],
    )
    def test_exception_is_one_sentence(self, options, sentence, tmp_path, refused):
        assert sentence in refused(["render", "--size", "64", *options, "-o", str(tmp_path / "out")])

    def test_exception_other_options_are_refused_by_name(self, rendered, refused):
        assert "made_from.options.masks (2 / 3)" in refused([*RENDER, "-o", str(rendered), "--masks", "3"])

    def test_exception_a_rank_that_is_no_number(self, monkeypatch, tmp_path, refused):
        monkeypatch.setenv("RANK", "first")
        assert "RANK in the environment must be a whole number, got 'first'" in refused([*RENDER, "-o", str(tmp_path)])
        monkeypatch.setenv("RANK", "1")
        assert "RANK in the environment must be below WORLD_SIZE, 1, got 1" in refused(["render", "-o", str(tmp_path)])
