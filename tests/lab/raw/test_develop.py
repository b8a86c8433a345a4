"""Developing: by hand on small captures, and against LibRaw's own pictures of real ones."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import rawpy
import torch
from kornia.color import rgb_to_linear_rgb

from kornia_tidy.lab.raw import RawCapture
from kornia_tidy.lab.raw.color import assumed_camera_to_srgb, camera_to_srgb
from kornia_tidy.lab.raw.develop import balance_factors, default_method, develop, srgb_matrix
from tests.base import BaseTester, shared
from tests.lab.raw.dng import XTRANS
from tests.lab.raw.test_capture import README, a_third
from tests.lab.raw.test_color import G1, G2

LINEAR = {
    "gamma": (1, 1),
    "no_auto_bright": True,
    "adjust_maximum_thr": 0.0,  # otherwise LibRaw takes the brightest count for white
    "output_bps": 16,
    "user_flip": 0,
}
# Of these LibRaw's half size is of other pixels: it repeats columns, and puts 2x2 squares on a 6x6 tile.
UNLIKE = ("raw/thorsted+digicam_corpus/DC120_P003908.KDC", "raw_synthetic/aloe_xtrans.dng")
HALVES = [name for name in README if name not in UNLIKE]
PICTURES = {  # of whole algorithms
    "raw/syoyo+tinydng/colorchart.dng": ("linear", "ppg", "dht"),
    "raw/haraldk+TwelveMonkeys/dng_test.dng": ("linear", "vng", "ahd", "dcb"),
}


def libraw(path, **options):
    """LibRaw's picture, linear, (C, H, W) in [0, 1]."""
    with rawpy.imread(str(path)) as raw:
        picture = raw.postprocess(**LINEAR, **options)
    return torch.from_numpy(picture.astype(np.float32)).permute(2, 0, 1) / 65535


def never_below_black(raw: RawCapture) -> RawCapture:
    """The capture as LibRaw sees it: it takes counts below black for black."""
    counts = raw.counts.clone()
    rows, columns = raw.tile
    for y in range(rows):
        for x in range(columns):
            black = raw.black[:, None, None] if raw.pattern is None else raw.black[y, x]
            counts[:, y::rows, x::columns] = torch.maximum(counts[:, y::rows, x::columns], black.ceil().int())
    return replace(raw, counts=counts)


def capture(letters="RGGB", levels=(300, 500, 500, 800), size=4, **more):
    """Flat colours between black 100 and white 1100."""
    counts = torch.tensor(levels).view(1, 2, 2).repeat(1, size // 2, size // 2)
    return replace(RawCapture.from_counts(counts, letters, 100, 1100), **more)


class TestDevelop(BaseTester):
    @pytest.mark.parametrize("name", a_third(HALVES))
    def test_feature_levels_balance_and_matrix_are_those_of_libraw(self, name):
        """On 2x2 planes, LibRaw's at half size, linear: within 1e-4 everywhere, 3e-5 on average for each channel.

        LibRaw takes counts below black for black, which only the second comparison does: without, 1e-4 on average.
        Where black is the same in three channels and absent in a fourth (linear DNG) LibRaw leaves it in the white
        level.
        """
        raw = RawCapture.open(shared(f"data/{name}"))
        options = {"use_camera_wb": True} if raw.white_balance is not None else {}
        theirs = libraw(shared(f"data/{name}"), half_size=True, **(options if raw.colors else {"user_wb": [1.0] * 4}))
        scale = float((raw.white - raw.black[0]) / raw.white) if raw.pattern is None and raw.colors else 1.0

        def difference(raw):
            balance = None if raw.white_balance is not None or raw.daylight_balance is None else "daylight"
            image = develop(raw, "half", balance, encoded=False, square_pixels=False, upright=False)
            assert image.shape == theirs.shape
            return ((image * scale).clamp(0, 1) - theirs).abs()

        assert difference(raw).mean((1, 2)).max() < 1e-4
        assert difference(never_below_black(raw)).mean((1, 2)).max() < 3e-5
        assert difference(never_below_black(raw)).max() < (2e-4 if scale < 1 else 1e-4)

    @pytest.mark.takes_seconds
    @pytest.mark.parametrize(
        ("name", "method"), [(name, method) for name, methods in PICTURES.items() for method in methods]
    )
    def test_feature_demosaiced_as_libraw_does_itself(self, name, method):
        """From our levels and balance: 2e-4 on average; its choices of direction flip where two are as good.

        Left alone: DHT looks at ratios of counts, and so at noise below black, which LibRaw itself never shows it.
        """
        raw = never_below_black(RawCapture.open(shared(f"data/{name}")))
        theirs = libraw(
            shared(f"data/{name}"), use_camera_wb=True, demosaic_algorithm=rawpy.DemosaicAlgorithm[method.upper()]
        )
        ours = develop(raw, f"libraw_{method}", encoded=False, upright=False).clamp(0, 1)
        assert (ours - theirs).abs().mean() < 2e-4
        if method == "linear":
            assert (ours - theirs).abs().max() < 1e-4

    def test_feature_by_hand(self):
        """Light 0.2, 0.4, 0.7; factors 2, 1, 1.5 give 0.4, 0.4, and 1.05, clipped."""
        raw = capture(white_balance=torch.tensor([2.0, 1.0, 1.5, 1.0]))
        options = {"matrix": torch.eye(3), "encoded": False}
        self.assert_close(develop(raw, "bilinear", **options)[:, 1, 1], torch.tensor([0.4, 0.4, 1.0]))
        keep = develop(raw, "bilinear", highlights="keep", **options)[:, 1, 1]
        self.assert_close(keep, torch.tensor([0.4, 0.4, 1.05]))
        half = develop(raw, "bilinear", white_balance=torch.tensor([1.0, 0.5, 0.75]), **options)[:, 1, 1]
        self.assert_close(half, torch.tensor([0.4, 0.4, 1.0]))  # only ratios count
        mixed = develop(raw, "bilinear", matrix=torch.tensor([[1.0, -1, 0], [0, 2, 0], [0.5, 0, 0.5]]), encoded=False)
        self.assert_close(mixed[:, 1, 1], torch.tensor([0.0, 0.8, 0.7]), atol=1e-6)

    def test_feature_saturated_is_white_whatever_the_balance(self):
        raw = capture(
            levels=(1100,) * 4, white_balance=torch.tensor([2.2, 1.0, 1.9, 1.0]), xyz_to_camera=torch.tensor(G2)
        )
        self.assert_close(develop(raw, "half"), torch.ones(3, 2, 2), atol=1e-5)

    def test_feature_encoding_is_srgb_and_invertible(self):
        raw = capture()
        linear = develop(raw, "half", matrix=torch.eye(3), encoded=False)
        self.assert_close(rgb_to_linear_rgb(develop(raw, "half", matrix=torch.eye(3))), linear)

    def test_feature_balance_is_the_files_then_daylight_then_none(self):
        shot, sun = torch.tensor([2.0, 1, 1.5, 1]), torch.tensor([1.8, 1, 1.7, 1])
        assert balance_factors(capture(white_balance=shot, daylight_balance=sun)).tolist() == shot.tolist()
        assert balance_factors(capture(daylight_balance=sun)).tolist() == sun.tolist()
        assert balance_factors(capture()).tolist() == [1.0] * 4
        assert balance_factors(capture(white_balance=shot), "none").tolist() == [1.0] * 4
        assert balance_factors(capture(), torch.tensor([3.0, 1.0, 2.0])).tolist() == [3.0, 1.0, 2.0, 1.0]

    def test_feature_daylight_that_nobody_asked_for_is_told(self):
        sun = torch.tensor([1.8, 1, 1.7, 1])
        with pytest.warns(UserWarning, match=r"for daylight, which leaves a cast .*='auto' \(--white-b"):
            told = develop(capture(daylight_balance=sun), "half")
        assert torch.equal(told, develop(capture(daylight_balance=sun), "half", "daylight"))
        develop(capture(daylight_balance=sun, white_balance=sun), "half")
        develop(capture(), "half")

    def test_feature_automatic_balance(self):
        """Light 0.1, 0.2, 0.05 becomes grey, as bright as green."""
        picture = develop(capture(levels=(200, 300, 300, 150)), "half", "auto", matrix=torch.eye(3), encoded=False)
        self.assert_close(picture, torch.full((3, 2, 2), 0.2))

    def test_feature_matrix_is_the_files_then_the_models_then_assumed(self):
        file, model = torch.eye(3) * 0.5, torch.tensor(G2)
        assert torch.equal(srgb_matrix(capture(camera_to_srgb=file, xyz_to_camera=model)), file)
        self.assert_close(srgb_matrix(capture(xyz_to_camera=model)), camera_to_srgb(model)[0])
        self.assert_close(srgb_matrix(capture()), assumed_camera_to_srgb()[0])
        four = capture("GMYC", xyz_to_camera=torch.tensor(G1))
        self.assert_close(srgb_matrix(four), camera_to_srgb(torch.tensor(G1))[0])

    def test_feature_pixels_become_square_about_the_middle(self):
        ramp = (100 + 10 * torch.arange(8)).expand(1, 4, 8)
        raw = replace(RawCapture.from_counts(ramp, None, 100, 200), pixel_aspect=1.5)
        wide = develop(raw, encoded=False)
        assert wide.shape == (1, 4, 12)
        self.assert_close(wide[0, 0, 2:-2], (torch.arange(2.5, 10) / 1.5 - 0.5) / 10)
        assert develop(replace(raw, pixel_aspect=0.5)).shape == (1, 8, 8)
        assert develop(replace(raw, pixel_aspect=0.5), square_pixels=False).shape == (1, 4, 8)

    def test_cardinality_monochrome_and_linear_rgb(self):
        grey = RawCapture.from_counts(torch.full((1, 5, 7), 600), None, 100, 1100)
        self.assert_close(develop(grey, encoded=False), torch.full((1, 5, 7), 0.5))
        rgb = RawCapture.from_counts(torch.full((3, 5, 7), 600), None, 100, 1100)
        self.assert_close(develop(rgb, encoded=False), torch.full((3, 5, 7), 0.5), atol=1e-5)

    def test_cardinality_every_kind_of_array_has_a_method(self):
        sides = {"RGGB": "libraw_ahd", "GMYC": "bilinear", XTRANS: "libraw_markesteijn", "RGBG": "bilinear"}
        for letters, method in sides.items():
            raw = RawCapture.from_counts(torch.full((1, 26, 30), 600), letters, 100, 1100)
            assert default_method(raw) == method
            colors = len(set(letters))
            # also a singular matrix, all colours to grey, is a matrix
            flat = develop(raw, matrix=torch.full((3, colors), 1 / colors), encoded=False)
            self.assert_close(flat, torch.full((3, 26, 30), 0.5), atol=2e-5)

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"highlights": "blend"}, "highlights must be one of 'clip', 'keep', got 'blend'"),
            ({"white_balance": "cloudy"}, "must be one of 'as shot', 'daylight', 'auto', 'none', got 'cloudy'"),
            ({"white_balance": "as shot"}, "the capture has no white balance 'as shot'"),
            ({"white_balance": torch.ones(2)}, "white_balance must be 3 positive factors, of R, G, B, got"),
            ({"white_balance": -torch.ones(3)}, "white_balance must be 3 positive factors"),
            ({"white_balance": torch.full((3,), torch.nan)}, "white_balance must be finite, got nan"),
            ({"matrix": torch.eye(4)}, r"matrix must have shape \(3, 3\), got \(4, 4\)"),
            ({"method": "best"}, "method of demosaicing must be one of"),
        ],
    )
    def test_exception_says_what_is_allowed(self, options, message):
        with pytest.raises(ValueError, match=message):
            develop(capture(), **options)

    def test_exception_unknown_filters(self):
        with pytest.raises(ValueError, match="the capture has no colour matrix for its filters GMCY: give a matrix"):
            develop(capture("GMYC"))
