from __future__ import annotations

import pytest
import torch

from kornia_tidy import PixelwiseMask, SensorNoise, TiDyOptics
from kornia_tidy.cli import main
from kornia_tidy.data import read_rgbd, write_image
from kornia_tidy.lab.calibration.noise import PhotonTransfer
from kornia_tidy.lab.calibration.noise.photon_transfer import TransferLine, write_json
from kornia_tidy.lab.raw import RawCapture, develop, simulate_scene
from tests.base import BaseTester

SCENE = ["raw", "simulate", "--image", "image.png", "--depth", "depth.pfm", "--fidelity", "draft", "--masks", "1"]


def seeded(seed):
    return torch.Generator().manual_seed(seed)


class TestRawSimulate(BaseTester):
    def test_feature_the_file_holds_what_python_gives(self, scene, capsys):
        assert main([*SCENE, "-o", "out.dng", "--pattern", "gbrg", "--bits", "14", "--seed", "5"]) == 0
        assert "GBRG filter array" in capsys.readouterr().out
        back = RawCapture.open("out.dng")
        image, depth, _ = read_rgbd("image.png", "depth.pfm")
        optics = TiDyOptics(PixelwiseMask(1, generator=seeded(0)), sensor=None, fidelity="draft")
        raw = simulate_scene(
            image,
            depth,
            optics,
            RawCapture.from_counts(torch.zeros(1, 2, 2), "GBRG", 1024, 16383),
            SensorNoise.physical(10500, 2.4),
            color="channels",
            generator=seeded(5),
        )
        assert torch.equal(back.counts, raw.counts)
        assert (back.pattern, back.white, float(back.black[0, 0])) == (raw.pattern, 16383, 1024)

    def test_feature_a_sensor_in_words_has_the_pictures_colours(self, scene):
        """The file says that its red, green and blue are sRGB's: developed by itself it shows the picture."""
        assert main([*SCENE, "-o", "out.dng", "--full-well", "1e7", "--read-noise", "0", "--bits", "16"]) == 0
        raw = RawCapture.open("out.dng")
        # The fractions of the file are of a millionth, twice; the inverse of the matrix makes at most seven of it.
        self.assert_close(raw.camera_to_srgb, torch.eye(3), atol=1e-4, rtol=0)
        self.assert_close(raw.white_balance, torch.ones(4), atol=1e-5, rtol=0)
        light = raw.planes()[[0, 1, 3]]
        self.assert_close(develop(raw, "half", encoded=False)[[0, 2]], light[[0, 2]].clamp(max=1), atol=1e-3, rtol=0)

    def test_feature_like_a_file_with_a_calibration(self, scene):
        assert main([*SCENE, "-o", "first.dng", "--pattern", "BGGR", "--bits", "10", "--black", "50"]) == 0
        line = TransferLine(10.0, 0.1, 5.0, 0.1, 0.0, 1.0, 1000)
        write_json("noise.json", PhotonTransfer("", None, "flats", 50.0, 1023.0, line, {}, ()))
        more = ["--like", "first.dng", "--noise", "noise.json", "--color", "channels"]
        assert main([*SCENE, "-o", "second.dng", *more]) == 0
        first, second = RawCapture.open("first.dng"), RawCapture.open("second.dng")
        assert second.pattern == first.pattern
        assert (second.white, float(second.black[0, 0])) == (1023, 50)
        assert not torch.equal(first.counts, second.counts)

    @pytest.mark.parametrize(
        ("arguments", "message"),
        [
            (["-o", "out.png"], "the output must be a .dng file, got out.png"),
            (["-o", "none/out.dng"], "there is no folder none"),
            (["-o", "out.dng", "--like", "image.png"], "image.png"),
            (["-o", "out.dng", "--like", "a.dng", "--bits", "12"], "leave out --bits"),
            (["-o", "out.dng", "--noise", "n.json", "--read-noise", "2"], "leave out --full-well and --read-noise"),
            (["-o", "out.dng", "--pattern", "RGB"], "a filter array's tile has 4 or 36 letters, got 'RGB'"),
            (["-o", "out.dng", "--pattern", "GMYC"], "needs a camera of red, green and blue"),
            (["-o", "out.dng", "--white", "1000"], "--white is of the file of --like: give that, or --bits"),
        ],
    )
    def test_exception_is_one_sentence_and_nothing_is_written(self, scene, refused, arguments, message):
        assert message in refused([*SCENE, *arguments])
        assert not list(scene.glob("*.dng"))


class TestThereAndBack(BaseTester):
    """`raw simulate` and `raw reconstruct` with the same lens and masks."""

    CAMERA = ("--masks", "1", "--f-number", "12", "--focus-distance", "0.65", "--depth-range", "0.5", "0.8")

    def test_feature_the_lens_is_traced_to_the_corner_of_the_first_file_that_is_there(self, scene, capsys):
        write_image("wide.png", torch.rand(3, 40, 1800))
        words = [*self.CAMERA, "--lens", "triplet-50mm", "--noise", "0.01", "-o", "sharp"]
        assert main(["raw", "reconstruct", "gone.png", "wide.png", *words, "--head", "tikhonov"]) == 2
        told = capsys.readouterr()
        assert "field to 7.2 mm" in told.out
        assert "1 of 2 in sharp" in told.out
        assert "asked for a field" not in told.err

    @pytest.mark.parametrize(
        ("words", "sentence"),
        [
            (["--lens", "single-50mm"], "--lens is of a camera whose masks are needed too: give --masks"),
            (["--f-number", "8"], "--f-number is of a camera whose masks are needed too: give --masks"),
            (["--masks", "1", "--lens", "lens"], "--lens must be one of 'double-gauss-50mm'"),
            (["--masks", "gone.npy"], "gone.npy"),
            (["--masks", "1", "--lens", "single-50mm", "--focal-length", "0.04"], "leave out --focal-length"),
            (["--lens", "single-50mm", "--head", "edof-5"], "edof-5 has its own camera: leave out --lens"),
            (["--masks", "1", "--head", "camera.safetensors"], "camera.safetensors has its own camera"),
            (["--masks", "1", "--psfs", "bank.safetensors"], "--psfs has its own lens, masks and distances"),
            (["--masks", "1"], "the noise of image.png is not known: give --noise"),
        ],
    )
    def test_exception_is_one_sentence_and_nothing_is_written(self, scene, refused, words, sentence):
        assert sentence in refused(["raw", "reconstruct", "image.png", *words, "-o", "sharp"])
        assert not list(scene.glob("sharp/*"))
