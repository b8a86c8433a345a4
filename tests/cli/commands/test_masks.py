from __future__ import annotations

import csv

import cv2
import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from kornia_tidy import LearnableDwellTimes, PixelwiseMask, TiDyOptics
from kornia_tidy.cli import main
from kornia_tidy.lab.mask_export import PanelPlacement, SLMFrames, read_slm_frames, slm_frames
from kornia_tidy.modulator import GreyLevels
from kornia_tidy.optics import NOA61
from tests.base import BaseTester


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A camera of three masks and heights of two on disk, in the folder in which the command runs."""
    optics = TiDyOptics(PixelwiseMask(3), modulator=LearnableDwellTimes((1, 2, 1)), fidelity="draft")
    save_file(optics.state_dict(), tmp_path / "camera.safetensors")
    np.save(tmp_path / "heights.npy", 1.5e-6 * np.random.default_rng(0).random((2, 7, 7)))
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(command):
    return main(["masks", *command.split()])


class TestMasks(BaseTester):
    def test_feature_show(self, folder, capsys):
        assert run("show camera.safetensors") == 0
        told = capsys.readouterr().out
        assert "3 of 23x23 pixels" in told
        assert "0.2500 0.5000 0.2500" in told

    def test_feature_out_and_back(self, folder, capsys):
        assert run("export heights.npy -o slm --panel 90x60 --bits 10 --suffix .tif --rotate 90 --flip up-down") == 0
        told = capsys.readouterr().out
        for words in ("90 x 60 px, 8 a mask pixel", "2 of 10 bits", "read back, phase differs by up to 0.003", "wrote"):
            assert words in told
        assert run("import slm -o back.npy") == 0
        assert np.abs(np.load("back.npy") - np.load("heights.npy")).max() <= 1060e-9 / 2**11 * 1.0001
        assert run("import slm -o back.npy --shown --force") == 0
        assert np.load("back.npy").max() < 1060e-9 < np.load("heights.npy").max()
        assert run("import slm -o back.safetensors") == 0
        assert load_file("back.safetensors")["masks.phase"].shape == (2, 7, 7)
        assert run("import slm") == 0

    def test_feature_every_option_reaches_the_panel(self, folder):
        curve = 7 * np.linspace(0, 1, 512) ** 1.2
        (folder / "lut.txt").write_text("Level;Phase\n" + "".join(f"{g};{p!r}\n" for g, p in enumerate(curve.tolist())))
        options = (
            "--bits 9 --wavelength 633e-9 --response lut.txt --panel 100x80 --panel-pitch 1e-5 --pupil-radius 2e-4 "
            "--offset 3 -5 --flip left-right --rotate 270 --material noa61"
        )
        assert run(f"export heights.npy -o slm {options}") == 0
        heights = torch.from_numpy(np.load("heights.npy"))
        frames = SLMFrames.of(heights, GreyLevels(9, response=curve), 633e-9, NOA61)
        expected = PanelPlacement((80, 100), 1e-5, 2e-4, (3, -5), "left-right", 270).place(frames.grey, 0)
        for k in range(2):
            picture = cv2.imread(f"slm/frame_00{k}.png", cv2.IMREAD_UNCHANGED)
            np.testing.assert_array_equal(picture, expected[k].numpy())
        assert torch.equal(read_slm_frames("slm").heights(), frames.heights())

    @pytest.mark.parametrize("panel", ["--phase-range 3.1416", "--response lut.txt"])
    def test_exception_frames_that_show_a_wrong_phase(self, panel, folder, capsys, monkeypatch):
        """A grey level too many, which is less than the widest gap between phases."""
        (folder / "lut.txt").write_text(" ".join(map(str, 0.5 + 3 * np.linspace(0, 1, 256) ** 2)))
        assert run(f"export heights.npy -o right --panel 90x60 {panel}") == 0
        nearest = slm_frames.nearest_level
        monkeypatch.setattr(slm_frames, "nearest_level", lambda *given: (nearest(*given) + 1).clamp(max=255))
        assert run(f"export heights.npy -o wrong --panel 90x60 {panel}") == 2
        assert "wrong does not hold the masks: phase differs by " in capsys.readouterr().err

    def test_feature_timing_of_learnt_and_given_dwell_times(self, folder):
        assert run("export camera.safetensors -o learnt --panel 92x92 --exposure 0.2") == 0
        rows = list(csv.DictReader((folder / "learnt" / "timing.csv").read_text().splitlines()))
        assert [float(row["dwell_ms"]) for row in rows] == pytest.approx([50, 100, 50], abs=1e-4)
        timing = "--dwell 1 1 2 --switching-time 0.01 --cyclic"
        assert run(f"export camera.safetensors -o given --panel 92x92 {timing}") == 0
        rows = list(csv.DictReader((folder / "given" / "timing.csv").read_text().splitlines()))
        assert [float(row["start_ms"]) for row in rows] == pytest.approx([0, 27.5, 55])
        assert [float(row["swap_ms"]) for row in rows] == pytest.approx([10, 10, 10])

    @pytest.mark.usefixtures("folder")
    def test_feature_heights(self):
        assert run("export camera.safetensors -o out.npy") == 0
        assert np.load("out.npy").shape == (3, 23, 23)

    @pytest.mark.parametrize(
        ("arguments", "sentence"),
        [
            ("show none.npy", "cannot read none.npy: there is no such file"),
            ("export heights.npy -o slm.png", "the suffix of what to write must be one of '', '.npy'"),
            ("export heights.npy -o none/slm", "cannot write none/slm: there is no folder none"),
            ("export heights.npy -o taken", "cannot write taken: it exists, and --force was not given"),
            ("export heights.npy -o taken --force", "it holds holiday.jpg, which is no file of a folder of frames"),
            ("export heights.npy -o heights.npy --force", "cannot write heights.npy: it is the input"),
            ("export heights.npy -o slm --panel 0x5", "--panel must be WIDTHxHEIGHT in pixels"),
            ("export heights.npy -o slm --response turn.txt --bits 2", "got 1 at level 2 (line 3) after 2: smooth"),
            ("export heights.npy -o slm --dwell 1 2 3", "there are 3 dwell shares for 2 masks"),
            ("import taken", "cannot read taken/frames.json: there is no such file"),
            ("import taken -o x.stl", "the suffix of what to write must be one of '.npy', '.safetensors'"),
        ],
    )
    def test_exception_is_one_sentence_and_nothing_is_written(self, arguments, sentence, folder, capsys):
        (folder / "taken").mkdir()
        (folder / "taken" / "holiday.jpg").write_bytes(b"sun")
        (folder / "turn.txt").write_text("0\n2\n1\n6")
        before = {p: p.stat().st_mtime_ns for p in folder.rglob("*")}
        assert run(arguments) == 2
        last = capsys.readouterr().err.strip().splitlines()[-1]
        assert "error: " in last
        assert sentence in last
        assert len(last) < 500
        assert {p: p.stat().st_mtime_ns for p in folder.rglob("*")} == before
