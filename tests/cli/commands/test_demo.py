from __future__ import annotations

import re
from unittest.mock import Mock

import pytest
import torch

from kornia_tidy.cli import main
from kornia_tidy.data import read_image
from kornia_tidy.figures import demonstration
from tests.base import BaseTester

NAMES = {"demo.png", "reconstruction.png", "scene.png", "depth.png", "joint_depth.png"}
NAMES |= {f"{camera}_{step}.png" for camera in ("coded", "joint") for step in ("capture", "closed_form", "network")}
NAMES |= {"flat_capture.png", "flat_closed_form.png"}


@pytest.fixture(autouse=True)
def small_pages(monkeypatch):
    monkeypatch.setattr(demonstration, "DOTS_PER_INCH", 40)


class TestDemo(BaseTester):
    @pytest.mark.takes_seconds
    def test_feature_writes_the_pictures_again_and_again(self, tmp_path, capsys):
        folder = tmp_path / "new" / "outputs"
        runs = []
        for _ in range(2):
            assert main(["demo", "-o", str(folder), "--size", "80"]) == 0
            told = capsys.readouterr().out
            written = {path.name for path in folder.iterdir()}
            assert all(str(folder / name) in told for name in written)
            assert written - {"flat_network.png"} == NAMES
            runs.append({name: read_image(folder / name) for name in NAMES})
        assert runs[0]["demo.png"].shape == (3, 264, 480)
        assert runs[0]["coded_capture.png"].shape == (3, 80, 80)
        page, again = (each.pop("demo.png") for each in runs)
        assert (page - again).abs().max() < 0.05  # matplotlib's text moves by less than a pixel after its first use
        assert all(torch.equal(runs[0][name], runs[1][name]) for name in runs[0])

    @pytest.mark.takes_seconds
    def test_feature_tells_what_closed_forms_and_networks_gain_at_equal_light(self, tmp_path, capsys):
        assert main(["demo", "-o", str(tmp_path), "--size", "128"]) == 0
        told = {line[:9].strip(): line for line in capsys.readouterr().out.splitlines()}
        numbers = {
            name: [float(value) for value in re.findall(r"([\d.]+) dB", told[name])]
            for name in ("coded", "flat", "joint")
        }
        for capture, *restored in numbers.values():
            assert min(restored) > capture
        gain = max(numbers["coded"][1:]) - max(numbers["flat"][1:])
        assert float(re.search(r"([+-][\d.]+) dB", told["verdict"]).group(1)) == pytest.approx(gain, abs=0.15)
        counts = re.findall(r"([\d,]+) electrons at f/([\d.]+)", told["light"])
        (wide, fast), (narrow, slow) = [(float(n.replace(",", "")), float(f)) for n, f in counts]
        assert wide / narrow == pytest.approx((slow / fast) ** 2, rel=0.06)  # of two digits each, 5 % at most
        assert slow > fast

    @pytest.mark.takes_seconds
    def test_feature_a_camera_made_up_on_the_command_line_is_restored_without_training(
        self, tmp_path, capsys, monkeypatch
    ):
        drawn = Mock(wraps=demonstration.draw_comparison)
        monkeypatch.setattr(demonstration, "draw_comparison", drawn)
        made_up = ["--masks", "2", "--family", "zernike", "--f-number", "20"]
        assert main(["demo", "-o", str(tmp_path), "--size", "128", *made_up]) == 0
        assert "The upper network restores any camera" in drawn.call_args.args[3][2]
        (line,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith("coded"))
        assert "2 masks, f/20" in line
        capture, closed_form, network = (float(value) for value in re.findall(r"([\d.]+) dB", line))
        assert min(closed_form, network) > capture

    def test_exception_families_are_named(self, tmp_path, refused):
        assert "spiral" in refused(["demo", "-o", str(tmp_path), "--family", "lens"])

    def test_exception_an_image_without_depth(self, tmp_path, monkeypatch, refused):
        monkeypatch.chdir(tmp_path)
        assert "--image and --depth belong together" in refused(["demo", "--image", "a.png"])
        assert list(tmp_path.iterdir()) == []
