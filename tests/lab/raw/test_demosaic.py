"""Demosaicing: flat colours, ramps, and the same algorithm by SciPy and LibRaw."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

from kornia_tidy.lab.raw.demosaic import METHODS, bilinear, demosaic
from kornia_tidy.lab.raw.filter_array import filter_tile, indexed_tile
from tests.base import BaseTester
from tests.lab.raw.dng import XTRANS

BAYER = ("RGGB", "BGGR", "GRBG", "GBRG")
FOR_BAYER = tuple(name for name in METHODS if name != "libraw_markesteijn")


def seen(image: torch.Tensor, letters: str) -> torch.Tensor:
    """Return the mosaic of an image (C, H, W) behind a filter array, with channels in the order of filter_tile."""
    tile, colors = filter_tile(letters)
    names = "".join(dict.fromkeys(colors))
    height, width = image.shape[-2:]
    rows = torch.arange(height)[:, None] % len(tile)
    columns = torch.arange(width) % len(tile[0])
    index = torch.tensor([[names.index(colors[i]) for i in row] for row in tile])[rows, columns]
    return image.gather(0, index[None])


class TestDemosaic(BaseTester):
    @pytest.mark.parametrize(
        ("colors", "tile", "methods"),
        [
            ("BGR", ((2, 1), (1, 0)), ("bilinear", "half", "libraw_ahd")),
            ("YCGM", ((2, 3), (0, 1)), ("bilinear", "half", "libraw_linear")),
        ],
    )
    def test_feature_channels_come_in_the_order_of_their_names(self, colors, tile, methods):
        levels = torch.tensor([0.1, 0.3, 0.5, 0.9])[: len(colors)]
        mosaic = levels[torch.tensor(tile)].repeat(12, 12)[None]
        for method in methods:
            self.assert_close(demosaic(mosaic, tile, colors, method)[:, 6, 6], levels, atol=1e-4)

    @pytest.mark.parametrize("method", [name for name in FOR_BAYER if name not in {"half", "libraw_linear"}])
    def test_feature_ramps_are_smooth_whatever_follows_edges(self, method):
        """A grey ramp of 1/64 a pixel has no edges: within a tenth of that step."""
        ramp = (torch.arange(40) / 64)[None, None].expand(3, 30, 40)
        image = demosaic(seen(ramp, "GRBG"), *filter_tile("GRBG"), method)
        assert (image - ramp)[:, 6:-6, 6:-6].abs().max() < 0.1 / 64

    @pytest.mark.parametrize("letters", [*BAYER, "GMYC", XTRANS])
    def test_feature_is_normalised_convolution_by_scipy(self, letters, dtype):
        """Normalised convolution: samples and mask convolved with a tent, divided, samples kept; float64, no border."""
        mosaic = torch.rand(1, 24, 30, dtype=dtype)
        ours = demosaic(mosaic, *filter_tile(letters))
        reach = 3 if letters == XTRANS else 2
        tent = reach - np.abs(np.arange(1 - reach, reach))
        kernel = np.outer(tent, tent).astype(float)
        for color in range(len(ours)):
            wanted = torch.zeros(len(ours), 24, 30)
            wanted[color] = 1
            mask = seen(wanted, letters)[0].double().numpy()
            values = ndimage.convolve(mosaic[0].double().numpy() * mask, kernel, mode="constant")
            mean = values / ndimage.convolve(mask, kernel, mode="constant")
            expected = np.where(mask > 0, mosaic[0].double().numpy(), mean)
            inside = (slice(reach, -reach), slice(reach, -reach))
            self.assert_close(ours[color][inside], torch.from_numpy(expected[inside]), atol=1e-6)

    def test_feature_half_is_the_mean_of_each_colour_of_a_tile(self):
        mosaic = torch.tensor([[[1.0, 2.0, 5.0, 6.0, 9.0], [3.0, 4.0, 7.0, 8.0, 9.0]]])
        half = demosaic(mosaic, *filter_tile("GRBG"), "half")
        assert half.tolist() == [[[2.0, 6.0]], [[2.5, 6.5]], [[3.0, 7.0]]]

    def test_feature_flat_colours_behind_a_quad_bayer_array_come_back(self):
        tile, colors = indexed_tile(["RRGG", "RRGG", "GGBB", "GGBB"], "RGB")
        levels = torch.tensor([0.2, 0.7, 0.5])
        flat = levels[torch.tensor(tile).repeat(5, 6)][None]
        for method in ("bilinear", "half"):
            image = demosaic(flat, tile, colors, method)
            self.assert_close(image, levels[:, None, None].expand_as(image))

    def test_feature_half_of_xtrans_is_by_squares_of_three(self):
        mosaic = torch.rand(1, 6, 6)
        half = demosaic(mosaic, *filter_tile(XTRANS), "half")
        for color, letter in enumerate("RGB"):
            for top, left in ((0, 0), (0, 3), (3, 0), (3, 3)):
                places = [(y, x) for y in range(top, top + 3) for x in range(left, left + 3)]
                samples = [mosaic[0, y, x].item() for y, x in places if XTRANS[6 * y + x] == letter]
                assert len(samples) == (5 if letter == "G" else 2)
                assert half[color, top // 3, left // 3].item() == pytest.approx(np.mean(samples), abs=1e-6)

    @given(
        st.sampled_from([*BAYER, "GMYC", "RGBG", XTRANS]), st.integers(6, 17), st.integers(6, 17), st.integers(0, 99)
    )
    @settings(max_examples=60)
    def test_feature_measured_values_stay_and_others_lie_between(self, letters, height, width, seed):
        mosaic = torch.randn(1, height, width, generator=torch.Generator().manual_seed(seed))
        tile, colors = filter_tile(letters)
        image = demosaic(mosaic, tile, colors)
        assert torch.equal(seen(image, letters), mosaic)
        assert image.min() >= mosaic.min() - 1e-6
        assert image.max() <= mosaic.max() + 1e-6

    @pytest.mark.parametrize("method", ["bilinear", "half", "libraw_ahd"])
    @pytest.mark.parametrize("lead", [(), (2,), (2, 3)])
    def test_cardinality_batches_are_as_one_by_one(self, lead, method, dtype):
        mosaic = torch.rand(*lead, 1, 24, 26, dtype=dtype)
        image = demosaic(mosaic, *filter_tile("BGGR"), method)
        assert image.shape == (*lead, 3, *((12, 13) if method == "half" else (24, 26)))
        assert image.dtype == dtype
        one = demosaic(mosaic.reshape(-1, 1, 24, 26)[-1], *filter_tile("BGGR"), method)
        bound = 1e-6 if method in {"bilinear", "half"} else 1e-4  # each spans its own range
        self.assert_close(image.reshape(-1, *image.shape[-3:])[-1], one, atol=bound)

    @pytest.mark.parametrize("method", ["bilinear", "half", "libraw_vng"])
    @pytest.mark.parametrize("half", [torch.float16, torch.bfloat16])
    def test_cardinality_half_precision_comes_back(self, method, half):
        image = demosaic(torch.full((1, 24, 24), 0.5, dtype=half), *filter_tile("RGGB"), method)
        assert image.dtype == half
        assert (image - 0.5).abs().max() < 4e-3

    @pytest.mark.parametrize("method", ["libraw_ahd", "libraw_markesteijn"])
    def test_cardinality_small_pictures_too(self, method):
        """LibRaw itself refuses Bayer below 22 pixels and X-Trans below 512."""
        letters = XTRANS if method == "libraw_markesteijn" else "RGGB"
        assert demosaic(torch.rand(1, 7, 9), *filter_tile(letters), method).shape == (3, 7, 9)

    def test_exception_says_what_is_allowed(self):
        mosaic = torch.rand(1, 8, 8)
        bayer, xtrans = filter_tile("RGGB"), filter_tile(XTRANS)
        quad, stripes = indexed_tile(["RRGG", "RRGG", "GGBB", "GGBB"], "RGB"), indexed_tile(["RGBRGB"] * 6, "RGB")
        for args, message in (
            ((mosaic, *bayer, "best"), "method of demosaicing must be one of 'bilinear', 'half'"),
            ((torch.rand(3, 8, 8), *bayer), r"mosaic must have shape \(..., 1, H, W\), got \(3, 8, 8\)"),
            ((torch.rand(8, 8), *bayer), r"mosaic must have shape \(..., 1, H, W\), got \(8, 8\)"),
            ((torch.rand(1, 1, 8), *bayer), "must hold one tile of 2 x 2 px, got 1 x 8"),
            ((mosaic, *filter_tile("GMYC"), "libraw_ahd"), "of a four-colour array must be one of 'linear', 'vng'"),
            ((mosaic, *xtrans, "libraw_ahd"), "X-Trans array must be one of 'markesteijn', got 'ahd'"),
            ((mosaic / 0, *bayer, "libraw_ahd"), "mosaic must be finite, got inf"),
            ((mosaic, *quad, "libraw_ahd"), "four-colour and X-Trans arrays, not RRGGRRGGGGBBGGBB: choose"),
            ((mosaic, *stripes, "libraw_markesteijn"), "LibRaw demosaics Bayer, four-colour and X-Trans arr"),
        ):
            with pytest.raises(ValueError, match=message):
                demosaic(*args)
        with pytest.raises(TypeError, match=r"mosaic must be floating point, got torch.int32"):
            demosaic(mosaic.int(), *bayer)

    @pytest.mark.parametrize("method", ["bilinear", "half"])
    def test_gradcheck(self, method):
        self.gradcheck(lambda mosaic: demosaic(mosaic, *filter_tile("GBRG"), method), (torch.rand(2, 1, 4, 6),))

    def test_gradcheck_xtrans(self):
        self.gradcheck(lambda mosaic: demosaic(mosaic, *filter_tile(XTRANS)), (torch.rand(1, 7, 8),))

    def test_convention_one_colour_is_a_mosaic_of_itself(self):
        assert torch.equal(bilinear(torch.ones(1, 3, 4), ((0,),)), torch.ones(1, 1, 3, 4))
