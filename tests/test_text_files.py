"""Text files as editors on other systems save them: with a byte order mark, in UTF-8, UTF-16 or UTF-32."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
import torch

from kornia_tidy.cli import main
from kornia_tidy.data import TUMSequence, described_folder
from kornia_tidy.data.calibration_files import read_calibration
from kornia_tidy.figures.learning_curve import draw_learning_curve
from kornia_tidy.files import read_text
from kornia_tidy.lab.calibration.noise.photon_transfer import read_json as read_noise
from kornia_tidy.lab.mask_export import SLMFrames, read_slm_frames, write_slm_frames
from kornia_tidy.modulator import GreyLevels
from kornia_tidy.training.callbacks import drop_rows_after
from kornia_tidy.training.coded_datasets.index import read_index
from kornia_tidy.training.record import training_record
from tests.base import BaseTester

FORMS = ("utf-8-sig", "utf-16", "utf-32", "utf-16-be with mark")
CALIB = "cam0=[3997.5 0 1176.7; 0 3997.5 1011.7; 0 0 1]\ndoffs=131.25\nbaseline=193.5\n"


def resave(path, form):
    """Save a text file as an editor does that writes a byte order mark."""
    text = path.read_bytes().decode()
    path.write_bytes(text.encode(form) if form in FORMS[:3] else b"\xfe\xff" + text.encode("utf-16-be"))


def _calibration(folder):
    (folder / "calib.txt").write_text(CALIB)
    return [folder / "calib.txt"], lambda: read_calibration(folder / "calib.txt")


def _times(folder):
    for part in ("rgb", "depth"):
        (folder / f"{part}.txt").write_text(f"1.5 {part}/1.png\n")
    return [folder / "rgb.txt", folder / "depth.txt"], lambda: TUMSequence(folder).pairs


def _listed(folder):
    (folder / "associations.txt").write_text("1.5 rgb/1.png 1.6 depth/1.png\n")
    return [folder / "associations.txt"], lambda: TUMSequence(folder).pairs


def _described(folder):
    for name, values in (("a.png", np.zeros((4, 6, 3), np.uint8)), ("a_depth.png", np.ones((4, 6), np.uint16))):
        assert cv2.imwrite(str(folder / name), values)
    (folder / "rgbd.json").write_text('{"image": "*.png", "depth": "*_depth.png"}')
    return [folder / "rgbd.json"], lambda: described_folder(folder).pairs


def _validation(folder):
    (folder / "validation.csv").write_text("epoch,val_loss\n0,0.5\n")
    return [folder / "validation.csv"], lambda: training_record(folder)


def _curve(folder):
    (folder / "training.csv").write_text("step,loss,epoch\n4,0.5,0\n")
    (folder / "validation.csv").write_text("step,val_image_psnr\n4,25\n")
    logs = [folder / "training.csv", folder / "validation.csv"]
    return logs, lambda: draw_learning_curve(folder).axes[1].lines[0].get_xydata().tolist()


def _log(folder):
    path = folder / "training.csv"
    path.write_text("step,loss\n1,0.5\n2,0.4\n")

    def kept():
        drop_rows_after(path, 1)
        return path.read_text()

    return [path], kept


def _index(folder):
    (folder / "index.csv").write_text("key,name,coded\n000000,a,a.png\n")
    return [folder / "index.csv"], lambda: read_index(folder)


def _noise(folder):
    (folder / "noise.json").write_text(json.dumps({"format": "nothing"}))

    def sentence():
        with pytest.raises(ValueError, match=r"noise\.json") as told:
            read_noise(folder / "noise.json")
        return str(told.value)

    return [folder / "noise.json"], sentence


def _frames(folder):
    write_slm_frames(folder / "slm", SLMFrames.of(1e-6 * torch.rand(1, 5, 5), GreyLevels(8)))
    return [folder / "slm/frames.json"], lambda: read_slm_frames(folder / "slm").heights().tolist()


def _response(folder):
    np.save(folder / "h.npy", 1e-6 * np.random.default_rng(0).random((1, 5, 5)))
    (folder / "lut.txt").write_text("\n".join(f"{2 * np.pi * (g / 256) ** 1.2:.6f}" for g in range(256)))

    def levels():
        command = [str(folder / "h.npy"), "-o", str(folder / "slm"), "--response", str(folder / "lut.txt"), "--force"]
        assert main(["masks", "export", *command, "--panel", "64x64"]) == 0
        return json.loads((folder / "slm/frames.json").read_text())["level_phases_rad"]

    return [folder / "lut.txt"], levels


KINDS = (
    _calibration,
    _times,
    _listed,
    _described,
    _validation,
    _curve,
    _log,
    _index,
    _noise,
    _frames,
    _response,
)


class TestTextFiles(BaseTester):
    @pytest.mark.parametrize("kind", KINDS)
    def test_feature_a_byte_order_mark_changes_nothing(self, kind, tmp_path):
        paths, read = kind(tmp_path)
        before = {path: path.read_bytes() for path in paths}
        expected = read()
        for form in FORMS:
            for path, data in before.items():
                path.write_bytes(data)
                resave(path, form)
            assert read() == expected, form

    def test_exception_what_is_no_text(self, tmp_path):
        for data, name in ((b"epoch\n\xff\n", "UTF-8"), (b"\xff\xfea", "UTF-16"), (b"\xff\xfe\0\0\xff", "UTF-32")):
            (tmp_path / "log.csv").write_bytes(data)
            with pytest.raises(ValueError, match=rf"cannot read .*log\.csv: it is no text in {name} "):
                read_text(tmp_path / "log.csv")
