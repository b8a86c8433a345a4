from __future__ import annotations

import sys

import pytest
import torch

from kornia_tidy import PixelwiseMask
from kornia_tidy.cli import main
from kornia_tidy.data.depth_files import write_depth
from kornia_tidy.data.image_files import read_image, write_image
from tests.base import BaseTester


class TestDemo(BaseTester):
    def test_feature_writes_the_picture_and_the_captures_again_and_again(self, tmp_path, capsys):
        folder = tmp_path / "new" / "outputs"
        names = {"demo.png", "scene.png", "coded_k1.png", "coded_k2.png"}
        runs = []
        for _ in range(2):
            assert main(["demo", "-o", str(folder), "--size", "80", "--masks", "2"]) == 0
            told = capsys.readouterr().out
            assert all(str(folder / name) in told for name in names)
            assert {p.name for p in folder.iterdir()} == names
            runs.append({name: read_image(folder / name) for name in names})
        assert runs[0]["demo.png"].shape == (3, 990, 1800)
        assert runs[0]["coded_k2.png"].shape == (3, 80, 80)
        assert all(torch.equal(runs[0][name], runs[1][name]) for name in names)

    @pytest.mark.filterwarnings("always")
    def test_feature_a_scene_of_ones_own_gets_a_fitting_camera(self, tmp_path, capsys):
        write_image(tmp_path / "image.png", torch.rand(1, 64, 96))
        write_depth(tmp_path / "depth.pfm", torch.linspace(3, 6, 64 * 96).view(1, 64, 96))
        files = ["--image", str(tmp_path / "image.png"), "--depth", str(tmp_path / "depth.pfm")]
        assert main(["demo", *files, "-o", str(tmp_path / "out"), "--masks", "2"]) == 0
        assert "(psi +20.00 to -20.00)" in capsys.readouterr().out
        assert read_image(tmp_path / "out" / "coded_k1.png").shape == (1, 64, 96)

    def test_convention_the_one_mask_is_the_first_of_several(self):
        one, several = (PixelwiseMask(k, generator=torch.Generator().manual_seed(0)) for k in (1, 5))
        assert torch.equal(one.phase[0], several.phase[0])

    @pytest.mark.parametrize(
        ("arguments", "sentence"),
        [
            (["--image", "a.png"], "--image and --depth belong together"),
            (["--masks", "1"], "--masks must be 2 or more, got 1"),
            (["--size", "0"], "height must be a positive integer, got 0"),
        ],
    )
    def test_exception_is_one_sentence(self, arguments, sentence, tmp_path, monkeypatch, capsys):
        monkeypatch.chdir(tmp_path)
        assert main(["demo", *arguments]) == 2
        assert sentence in capsys.readouterr().err
        assert list(tmp_path.iterdir()) == []

    def test_exception_without_matplotlib_comes_before_any_work(self, tmp_path, monkeypatch, capsys):
        monkeypatch.chdir(tmp_path)
        monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
        assert main(["demo"]) == 2
        assert "pip install 'kornia-tidy[plot]'" in capsys.readouterr().err
        assert list(tmp_path.iterdir()) == []
