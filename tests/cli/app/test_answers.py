from __future__ import annotations

import numpy as np
import pytest
import torch

from kornia_tidy.cli.app import answers
from kornia_tidy.cli.app.answers import KEPT, PICTURES, answer
from kornia_tidy.cli.app.capture import take_picture
from kornia_tidy.cli.app.legends import legends, mistake
from kornia_tidy.cli.app.pictures import masks_and_psfs, photograph
from kornia_tidy.cli.app.settings import Settings
from kornia_tidy.data import write_depth, write_image
from tests.base import BaseTester

pytest.importorskip("matplotlib", reason="depth maps and masks are drawn with matplotlib")

SMALL = {"side": 96}


@pytest.fixture(scope="module")
def trained():
    return take_picture(Settings(**SMALL))


@pytest.fixture(scope="module")
def own():
    return take_picture(Settings(camera="own", start="flat", **SMALL))


class TestAnswer(BaseTester):
    def test_smoke_the_default(self):
        found = answer(SMALL)
        assert set(found.pictures) == set(found.legends) == set(PICTURES)
        for picture in found.pictures.values():
            assert picture.dtype == np.uint8
            assert picture.shape[2] == 3
            assert picture.std() > 10
        assert found.message.startswith("50 mm f/28.5, focus at 0.595 m")
        assert found.script.startswith('"""A coded capture')

    def test_feature_no_picture_of_a_depth_that_is_not_estimated(self):
        found = answer({"camera": "own", **SMALL})
        assert set(PICTURES) - set(found.pictures) == {"estimate"}
        assert found.legends["estimate"].startswith("**No depth estimate**")

    def uploaded(self, folder, depth, **values):
        write_image(folder / "photo.png", torch.rand(3, 72, 96))
        if depth is not None:
            write_depth(folder / "depth.npy", depth)
        files = {"image_file": str(folder / "photo.png"), "depth_file": str(folder / "depth.npy")}
        return answer({"scene": "files", **files, **SMALL, **values})

    def test_feature_uploaded_files(self, tmp_path):
        found = self.uploaded(tmp_path, torch.linspace(0.5, 2, 96).expand(1, 72, 96).contiguous())
        assert found.pictures["scene"].shape == (72, 96, 3)
        assert "    image_file='photo.png',\n    depth_file='depth.npy',\n    side=96,\n" in found.script

    @pytest.mark.parametrize(
        ("depth", "values", "sentence"),
        [
            (torch.ones(1, 24, 32), {}, "Photo and depth map must have the same size, got 96 x 72 and 32 x 24 pixels"),
            (torch.full((1, 72, 96), 1500.0), {}, "The middle depth of depth.npy would be 1.5e+03 m"),
            (None, {}, "There is no file depth.npy: upload it again"),
            (torch.ones(1, 72, 96), {"depth_file": None}, "The depth map of the photo is missing: upload both"),
            (torch.ones(1, 72, 96), {}, "The whole scene lies at 1 m, and one depth cannot be stretched or fitted"),
            (torch.ones(1, 72, 96), {"noise": None}, "Read noise (% of full scale): give a number"),
        ],
    )  # fmt: skip
    def test_exception_is_one_sentence_without_folders(self, tmp_path, capsys, depth, values, sentence):
        found = self.uploaded(tmp_path, depth, **values)
        assert found.message.startswith(f"**{sentence}")
        assert found.message.endswith(f".** {KEPT}")
        assert str(tmp_path) not in found.message
        assert found[1:] == ({}, {}, "")
        assert capsys.readouterr().err == ""

    @pytest.mark.parametrize("content", [b"", b"no picture", b"\x89PNG\r\n\x1a\n" + bytes(40)])
    def test_exception_files_that_are_none(self, tmp_path, content):
        (tmp_path / "photo.png").write_bytes(content)
        write_depth(tmp_path / "depth.npy", torch.ones(1, 48, 64))
        files = {"image_file": str(tmp_path / "photo.png"), "depth_file": str(tmp_path / "depth.npy")}
        message = answer({"scene": "files", **files}).message
        assert message.startswith("**Cannot read photo.png")
        assert str(tmp_path) not in message

    def test_exception_a_fault_of_the_library_is_told_and_printed(self, monkeypatch, capsys):
        monkeypatch.setattr(answers, "draw", lambda result: 1 / 0)
        assert "a fault of kornia-tidy, not yours (ZeroDivisionError: division by zero)" in answer(SMALL).message
        assert "Traceback" in capsys.readouterr().err


class TestLegends(BaseTester):
    def test_feature_numbers_are_those_of_the_result(self, trained):
        words, scores = legends(trained), trained.scores()
        assert "96 x 72 pixels" in words["scene"]
        assert f"PSNR {scores['capture_psnr']:.1f} dB" in words["capture"]
        assert "5 masks, in turn; gather, noise 0.2 % of full scale" in words["capture"]
        assert f"by the network of joint-uncertain. PSNR {scores['image_psnr']:.1f} dB" in words["image"]
        assert f"RMSE {scores['depth_rmse']:.2f} of the range" in words["estimate"]
        assert f"{trained.optics.window} x {trained.optics.window} pixels" in words["psfs"]

    @pytest.mark.parametrize(
        ("error", "sentence"),
        [
            (MemoryError(), "There is not enough memory for these settings: make the picture smaller."),
            (RuntimeError("can't allocate memory: 1 TB"), "There is not enough memory for these settings"),
            (KeyError("no such key"), "No such key."),
            (RuntimeError("a\nb"), "This is a fault of kornia-tidy, not yours (RuntimeError: a b); please report it."),
            (ValueError(), "ValueError."),
        ],
    )
    def test_feature_every_error_is_one_sentence(self, error, sentence):
        assert mistake(error).startswith(sentence)


class TestPictures(BaseTester):
    def test_feature_bytes_are_rounded_and_clipped(self):
        image = torch.tensor([-0.1, 0.5 / 255, 1.6 / 255, 1.2, 1.0, 0.2]).view(3, 1, 2)
        assert photograph(image).tolist() == [[[0, 2, 255], [0, 255, 51]]]

    def test_cardinality_of_many_masks_five_are_shown(self, trained):
        many = take_picture(Settings(camera="own", start="noise", masks=8, **SMALL))
        assert masks_and_psfs(many).shape == masks_and_psfs(trained).shape
