from __future__ import annotations

import pytest
import torch

from kornia_tidy.cli import main
from kornia_tidy.data import read_image, write_depth, write_image
from kornia_tidy.optics import SYSTEMS, systems_table
from kornia_tidy.reconstruction.tasks import metres
from tests.base import BaseTester


class TestSystems(BaseTester):
    @pytest.mark.takes_seconds
    def test_feature_lists_and_draws_those_asked_for_the_same_again(self, tmp_path, capsys):
        path, pictures = tmp_path / "two.png", []
        for _ in range(2):
            assert main(["systems", "--systems", "phasecam3d, tidy-1", "-o", str(path), "--size", "64"]) == 0
            lines = capsys.readouterr().out.splitlines()
            assert [line.split()[0] for line in lines[:3]] == ["name", "phasecam3d", "tidy-1"]
            assert any(str(path) in line for line in lines)
            pictures.append(read_image(path))
        assert torch.equal(*pictures)
        assert pictures[0].shape[0] == 3
        assert pictures[0].shape[2] > 2000

    @pytest.mark.takes_seconds
    @pytest.mark.parametrize("channels", [1, 3])
    def test_feature_a_scene_of_ones_own_wherever_its_depths_lie(self, channels, tmp_path, capsys):
        write_image(tmp_path / "image.png", torch.rand(channels, 64, 96))
        write_depth(tmp_path / "depth.pfm", torch.linspace(30, 60, 64 * 96).view(1, 64, 96))
        files = ["--image", str(tmp_path / "image.png"), "--depth", str(tmp_path / "depth.pfm")]
        output = str(tmp_path / "out.jpg")
        assert main(["systems", "--systems", "chang2019", *files, "-o", output, "--size", "48"]) == 0
        assert "warning" not in capsys.readouterr().err
        assert read_image(output).shape[0] == 3

    def test_feature_depth_is_stretched_evenly_in_dioptres(self):
        inverse_depth = torch.tensor([0.0, 0.25, 1.0])
        for system in SYSTEMS.values():
            camera = system.camera()
            lo, hi = camera.defocus_range
            psi = camera.defocus(metres(camera, inverse_depth))
            self.assert_close(psi, torch.tensor([lo, 0.75 * lo + 0.25 * hi, hi]), rtol=0, atol=2e-3)

    def test_feature_the_table_has_a_line_for_each_system_and_its_guesses(self):
        lines = systems_table(list(SYSTEMS.values()))
        assert [line.split("  ")[0] for line in lines[1:]] == list(SYSTEMS)
        column = lines[0].index("guessed")
        assert [int(line[column:].split()[0]) for line in lines[1:]] == [len(s.guesses) for s in SYSTEMS.values()]

    @pytest.mark.parametrize(
        ("arguments", "sentence"),
        [
            (["--systems", "tidy"], "--systems must be some of tidy-5, tidy-1"),
            (["--image", "a.png"], "--image and --depth belong together"),
            (["-o", "systems.pdf"], "the suffix of an image file must be one of"),
            (["-o", "nowhere/systems.png"], "there is no folder nowhere"),
        ],
    )
    def test_exception_is_one_sentence(self, arguments, sentence, tmp_path, monkeypatch, refused):
        monkeypatch.chdir(tmp_path)
        assert sentence in refused(["systems", *arguments])
        assert list(tmp_path.iterdir()) == []
