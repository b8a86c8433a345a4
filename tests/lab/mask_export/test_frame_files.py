"""Folders of SLM frames: contents of the files read with OpenCV alone, and no partial folders after errors."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from kornia_tidy.lab.mask_export import PanelPlacement, SLMFrames, frame_times, read_slm_frames, write_slm_frames
from kornia_tidy.lab.mask_export.placement import FLIPS, ROTATIONS
from kornia_tidy.modulator import GreyLevels
from tests.base import BaseTester

SMALL = PanelPlacement((48, 60))


def some_frames(bits=8, masks=2, size=5, span=1.2e-6):
    return SLMFrames.of(span * torch.rand(masks, size, size, dtype=torch.float64), GreyLevels(bits))


class TestWriteSLMFrames(BaseTester):
    @pytest.mark.parametrize("suffix", [".png", ".tif", ".tiff"])
    @pytest.mark.parametrize("bits", [1, 8, 9, 10])
    def test_feature_the_numbers_in_the_files_are_the_grey_levels(self, tmp_path, bits, suffix):
        """One wave at 530 nm is 1060 nm of height; a pixel's value is its level, in 8 or 16 bits, on 52 x 52 pixels."""
        step = 1060e-9 / 2**bits
        levels = torch.arange(23 * 23).view(1, 23, 23) * 7 % 2**bits
        levels[0, 3, 20] = 2**bits - 1
        frames = SLMFrames.of(levels.double() * step, GreyLevels(bits))
        write_slm_frames(tmp_path / "slm", frames, suffix=suffix)
        picture = cv2.imread(str(tmp_path / "slm" / f"frame_000{suffix}"), cv2.IMREAD_UNCHANGED)
        assert (picture.shape, picture.dtype) == ((1200, 1920), np.uint8 if bits <= 8 else np.uint16)
        expected = np.zeros((1200, 1920), int)
        expected[2:1198, 362:1558] = np.kron(levels[0].numpy(), np.ones((52, 52), int))
        np.testing.assert_array_equal(picture, expected)

    def test_feature_a_measured_response_is_written_through(self, tmp_path):
        """The panel has the response 2 pi (g / 255)**1.5, so a quarter wave needs level 255 / 4**(2/3) = 101.2."""
        curve = 2 * math.pi * (torch.arange(256) / 255.0) ** 1.5
        heights = torch.tensor([[[0.0, 265e-9], [530e-9, 795e-9]]], dtype=torch.float64)
        write_slm_frames(tmp_path / "slm", SLMFrames.of(heights, GreyLevels(8, response=curve)), SMALL)
        picture = cv2.imread(str(tmp_path / "slm" / "frame_000.png"), cv2.IMREAD_UNCHANGED)
        assert picture[[0, 0, 47, 47], [6, 53, 6, 53]].tolist() == [0, 101, 161, 210]  # 255 * t**(2/3)

    def test_feature_sidecar_and_timing_tell_what_a_lab_needs(self, tmp_path):
        times = frame_times((1, 2, 1), 0.1, 5e-3)
        placement = PanelPlacement((480, 640), 12.5e-6, 2e-3, (10, -4), "up-down", 270)
        write_slm_frames(tmp_path / "slm", some_frames(10, 3, 23), placement, times)
        about = json.loads((tmp_path / "slm" / "frames.json").read_text())
        expected = {
            "bits": 10,
            "bits_of_file": 16,
            "panel": [480, 640],
            "panel_pitch_m": 12.5e-6,
            "pupil_radius_m": 2e-3,
            "panel_pixels_per_mask_pixel": 16.0,
            "offset_right_down": [10, -4],
            "flip": "up-down",
            "rotate": 270,
            "wavelength_m": 530e-9,
            "mask": [23, 23],
        }
        for key, value in expected.items():
            assert about[key] == (pytest.approx(value, rel=1e-12) if isinstance(value, float) else value)
        assert "least significant bits" in about["alignment"]
        rows = list(csv.DictReader((tmp_path / "slm" / "timing.csv").read_text().splitlines()))
        assert [row["file"] for row in rows] == about["files"] == [f"frame_00{k}.png" for k in range(3)]
        assert [float(row["start_ms"]) for row in rows] == [0, 27.5, 77.5]

    @pytest.mark.parametrize(
        ("call", "kind", "sentence"),
        [
            ({"suffix": ".jpg"}, ValueError, "suffix must be one of '.png', '.tif', '.tiff', got '.jpg'"),
            ({"times": frame_times((1, 1, 1), 0.1)}, ValueError, "times must be one for each of the 2 masks, got 3"),
            ({"placement": PanelPlacement((3, 3))}, ValueError, "a mask of 5x5 pixels must have pixels at least"),
            ({"folder": "none/slm"}, FileNotFoundError, "there is no folder"),
            ({"folder": "taken"}, FileExistsError, "taken: it exists"),
            ({"folder": "taken", "replace": True}, FileExistsError, "it holds holiday.jpg, which is no file of"),
            ({"folder": "file", "replace": True}, FileExistsError, "file: it is a file, not a folder of frames"),
        ],
    )
    def test_exception_leaves_everything_as_it_was(self, tmp_path, call, kind, sentence):
        (tmp_path / "taken").mkdir()
        (tmp_path / "taken" / "holiday.jpg").write_bytes(b"sun")
        (tmp_path / "file").write_bytes(b"text")
        before = sorted(tmp_path.rglob("*"))
        call = {"placement": SMALL, **call, "folder": tmp_path / call.get("folder", "slm")}
        with pytest.raises(kind, match=sentence):
            write_slm_frames(frames=some_frames(), **call)
        assert sorted(tmp_path.rglob("*")) == before

    def test_exception_a_folder_that_cannot_be_put_in_place_leaves_the_one_before(self, tmp_path, monkeypatch):
        first = some_frames()
        write_slm_frames(tmp_path / "slm", first, SMALL)
        rename = Path.rename

        def fails(path, target):
            if target == tmp_path / "slm" and not hasattr(fails, "done"):
                fails.done = True
                raise OSError(5, "Input/output error")
            return rename(path, target)

        monkeypatch.setattr(Path, "rename", fails)
        with pytest.raises(OSError, match="Input/output"):
            write_slm_frames(tmp_path / "slm", some_frames(), SMALL, replace=True)
        assert [entry.name for entry in tmp_path.iterdir()] == ["slm"]
        assert torch.equal(read_slm_frames(tmp_path / "slm").grey, first.grey)

    def test_feature_frames_written_before_are_replaced_whole(self, tmp_path):
        write_slm_frames(tmp_path / "slm", some_frames(masks=4), SMALL)
        later = some_frames(masks=1, span=0.5e-6)
        write_slm_frames(tmp_path / "slm", later, SMALL, replace=True)
        assert sorted(p.name for p in (tmp_path / "slm").iterdir()) == ["frame_000.png", "frames.json", "timing.csv"]
        assert torch.equal(read_slm_frames(tmp_path / "slm").grey, later.grey)


class TestReadSLMFrames(BaseTester):
    @settings(max_examples=30)
    @given(
        st.integers(1, 10),
        st.tuples(st.integers(1, 3), st.integers(1, 7), st.integers(1, 7)),
        st.floats(2, 4 * math.pi),
        st.sampled_from(FLIPS),
        st.sampled_from(ROTATIONS),
        st.floats(0.6, 5),
        st.floats(420e-9, 1500e-9),
        st.integers(0, 2**32),
    )
    def test_feature_everything_comes_back(self, tmp_path_factory, bits, shape, span, flip, rotate, scale, wave, seed):
        heights = torch.from_numpy(np.random.default_rng(seed).uniform(-2e-6, 3e-6, shape))
        radius = max(scale, 1) * min(shape[1:]) * 8e-6 / 2.3
        placement = PanelPlacement((50, 64), 8e-6, radius, (3, -2), flip, rotate)
        frames = SLMFrames.of(heights, GreyLevels(bits, span), wave)
        folder = tmp_path_factory.mktemp("frames") / "slm"
        write_slm_frames(folder, frames, placement)
        back = read_slm_frames(folder)
        assert torch.equal(back.grey, frames.grey)
        assert torch.equal(back.heights(), frames.heights())
        error = (back.heights() - heights).abs().max() * back.radians_per_metre
        assert float(error) <= back.largest_error() + 1e-9

    @pytest.mark.parametrize(
        ("damage", "sentence"),
        [
            (lambda f: (f / "frame_001.png").unlink(), "frame_001.png: there is no such file"),
            (lambda f: (f / "frames.json").unlink(), "frames.json: there is no such file"),
            (lambda f: (f / "frames.json").write_text("{}"), "its format is not 'kornia-tidy SLM frames 1'"),
            (lambda f: (f / "frames.json").write_text("{"), "cannot read .*frames.json"),
            (lambda f: edit(f, mask=None), "describe frames: mask must be rows and columns, got None"),
            (lambda f: edit(f, flip="sideways"), "does not describe frames: flip must be one of"),
            (lambda f: edit(f, mask=[50, 50]), "does not describe frames: a mask of 50x50"),
            (lambda f: (f / "frame_000.png").write_bytes(b"\x89PNG"), "cannot read .*frame_000.png"),
            (lambda f: (f / "turns.npy").write_bytes(b"\x93NUMPY"), "cannot read .*turns.npy"),
            (lambda f: (f / "turns.npy").unlink(), "turns.npy: there is no such file"),
            (lambda f: np.save(f / "turns.npy", np.zeros((1, 2, 2), np.int16)), r"must have shape \(2, 5, 5\)"),
            (lambda f: np.save(f / "turns.npy", np.zeros((2, 5, 5))), "whole waves must be int16, got float64"),
            (lambda f: picture(f, np.zeros((48, 60), np.uint8)), None),
            (lambda f: picture(f, np.zeros((48, 61), np.uint8)), "frame_000.png: frames must have the panel's"),
            (lambda f: picture(f, np.zeros((48, 60), np.uint16)), "must be a grey picture of 8 bits, got uint16"),
            (lambda f: picture(f, np.zeros((48, 60, 3), np.uint8)), "must be a grey picture of 8 bits, got uint8 in 3"),
            (lambda f: picture(f, np.full((48, 60), 64, np.uint8)), "must hold grey levels from 0 to 63, found 64"),
            (lambda f: picture(f, np.eye(48, 60, dtype=np.uint8)), "frame_000.png: .* found a mixed block"),
        ],
    )
    def test_exception_names_what_is_damaged(self, tmp_path, damage, sentence):
        write_slm_frames(tmp_path / "slm", some_frames(bits=6, span=3e-6), SMALL)
        damage(tmp_path / "slm")
        if sentence is None:
            assert int(read_slm_frames(tmp_path / "slm").grey[0].max()) == 0
            return
        with pytest.raises((ValueError, FileNotFoundError), match=sentence):
            read_slm_frames(tmp_path / "slm")


def edit(folder, **values):
    path = folder / "frames.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **values}))


def picture(folder, values):
    cv2.imwrite(str(folder / "frame_000.png"), values)
