"""`kornia-tidy raw develop` on small DNG files."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from kornia_tidy.cli import main
from kornia_tidy.data import read_image
from kornia_tidy.lab.raw import RawCapture, develop
from tests.base import BaseTester
from tests.lab.raw.dng import dng, patched


@pytest.fixture
def files(tmp_path):
    """Three good files and, between them, one cut short."""
    for name, pattern in (("a", "RGGB"), ("c", "GBRG"), ("d", None)):
        shape, black = ((30, 40), (64,)) if pattern else ((30, 40, 3), (64, 64, 64))
        counts = np.random.default_rng(0).integers(64, 1000, shape)
        (tmp_path / f"{name}.dng").write_bytes(dng(counts, pattern, black))
    (tmp_path / "b.dng").write_bytes((tmp_path / "a.dng").read_bytes()[:1500])
    return [str(tmp_path / f"{name}.dng") for name in "abcd"]


class TestRawDevelop(BaseTester):
    def test_feature_one_bad_file_never_stops_the_rest(self, files, tmp_path, capsys):
        folder = tmp_path / "out" / "pictures"
        assert main(["raw", "develop", *files, "-o", str(folder)]) == 2
        out, err = capsys.readouterr()
        assert sorted(path.name for path in folder.iterdir()) == sorted(
            f"{s}.{x}" for s in "acd" for x in ("png", "jpg")
        )
        assert "3 developed, 0 kept, 1 failed or left" in out
        assert "1/4" in out
        assert "4/4" in out
        assert "b.dng: it is cut short" in err
        assert "1 of 4 files failed" in err
        assert "Traceback" not in err

    def test_feature_file_holds_what_the_library_gives(self, files, tmp_path):
        assert main(["raw", "develop", files[0], "-o", str(tmp_path), "--format", "tiff", "--linear"]) == 0
        stored = cv2.imread(str(tmp_path / "a.tif"), cv2.IMREAD_UNCHANGED)
        assert stored.dtype == np.uint16
        raw = RawCapture.open(files[0])
        self.assert_close(read_image(tmp_path / "a.tif"), develop(raw, encoded=False).clamp(0, 1), atol=1 / 65535)
        preview = read_image(tmp_path / "a.jpg")
        assert (preview - develop(raw).clamp(0, 1)).mean().abs() < 0.02  # JPEG of noise, encoded

    def test_feature_options_reach_the_picture(self, files, tmp_path):
        options = "--demosaic half --white-balance 2 1 1.5 --highlights keep --no-preview"
        assert main(["raw", "develop", files[2], "-o", str(tmp_path), *options.split()]) == 0
        expected = develop(
            RawCapture.open(files[2]), "half", white_balance=torch.tensor([2.0, 1.0, 1.5]), highlights="keep"
        )
        self.assert_close(read_image(tmp_path / "c.png"), expected.clamp(0, 1), atol=1 / 65535)
        assert not (tmp_path / "c.jpg").exists()

    def test_feature_dump_with_its_levels(self, tmp_path):
        counts = np.random.default_rng(0).integers(100, 900, (24, 30)).astype("<u2")
        (tmp_path / "dump.raw").write_bytes(counts.tobytes())
        levels = "--size 30x24 --pattern BGGR --black 100 --white 1000"
        assert main(["raw", "develop", str(tmp_path / "dump.raw"), "-o", str(tmp_path), *levels.split()]) == 0
        assert read_image(tmp_path / "dump.png").shape == (3, 24, 30)

    @pytest.mark.filterwarnings("default::UserWarning")
    def test_feature_automatic_balance_of_what_says_none(self, tmp_path, capsys):
        """Without AsShotNeutral LibRaw has daylight from the matrix; a grey scene under a green light turns grey."""
        grey = np.random.default_rng(0).integers(20, 80, (12, 16)).repeat(2, 0).repeat(2, 1)
        counts = 64 + grey * np.tile([[6, 9], [9, 3]], (12, 16))
        (tmp_path / "green.dng").write_bytes(patched(dng(counts), 50728, tag=50700))
        out = ["-o", str(tmp_path), "--demosaic", "half", "--linear"]
        assert main(["raw", "develop", str(tmp_path / "green.dng"), *out]) == 0
        told = capsys.readouterr().err
        assert told.startswith("kornia-tidy: warning: a file without a white balance as shot is balanced for daylight")
        assert told.count("\n") == 1
        casts = read_image(tmp_path / "green.png").mean((1, 2))
        assert main(["raw", "develop", str(tmp_path / "green.dng"), *out, "--white-balance", "auto"]) == 0
        assert capsys.readouterr().err == ""
        mean = read_image(tmp_path / "green.png").mean((1, 2))
        assert casts.argmax() == 1
        self.assert_close(mean, mean.mean().expand(3), rtol=5e-3, atol=0)

    def test_feature_resume_keeps_what_is_there(self, files, tmp_path, capsys):
        good = [files[0], files[2]]
        command = ["raw", "develop", *good, "-o", str(tmp_path), "--resume"]
        assert main(command) == 0
        before = (tmp_path / "a.png").stat().st_mtime_ns
        (tmp_path / "c.png").unlink()
        assert main(command) == 0
        assert "1 developed, 1 kept, 0 failed or left" in capsys.readouterr().out
        assert (tmp_path / "a.png").stat().st_mtime_ns == before
        assert (tmp_path / "c.png").exists()
        assert main(command[:-1]) == 0
        assert (tmp_path / "a.png").stat().st_mtime_ns != before

    @pytest.mark.parametrize(
        ("extra", "message"),
        [
            (["--white-balance", "cloudy"], "--white-balance is as-shot, daylight, auto, none, or factors, got cloudy"),
            (["--white-balance", "1", "2"], "white_balance must be 3 positive factors, of R, G, B, got [1.0, 2.0]"),
            (["--demosaic", "libraw_markesteijn"], "LibRaw's demosaicing of a Bayer array must be one of"),
            (["elsewhere/a.cr2"], "a.dng and elsewhere/a.cr2 would both become"),
        ],
    )
    def test_exception_is_one_sentence(self, files, tmp_path, capsys, extra, message):
        assert main(["raw", "develop", "-o", str(tmp_path / "out"), files[0], *extra]) == 2
        err = capsys.readouterr().err
        assert message in err
        assert err.count("\n") == 1
        assert not list(tmp_path.glob("out/*"))

    def test_exception_never_replaces_an_input(self, tmp_path, refused):
        (tmp_path / "scan.tif").write_bytes(dng(np.full((30, 40), 500)))
        before = (tmp_path / "scan.tif").read_bytes()
        command = ["raw", "develop", str(tmp_path / "scan.tif"), "-o", str(tmp_path), "--format", "tiff"]
        assert "it is an input" in refused(command)
        assert "it is not a folder" in refused([*command[:4], str(tmp_path / "scan.tif")])
        assert (tmp_path / "scan.tif").read_bytes() == before
