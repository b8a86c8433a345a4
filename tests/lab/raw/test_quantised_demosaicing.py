"""Quantised demosaicing: bands of rows give the same result as the whole picture, and only quantisation is lost."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from kornia_tidy.lab.raw import demosaic as demosaicing
from kornia_tidy.lab.raw import quantised_demosaicing
from kornia_tidy.lab.raw.demosaic import LIBRAW, LIBRAW_LOCAL, LIBRAW_REACH, demosaic
from kornia_tidy.lab.raw.filter_array import filter_tile
from kornia_tidy.lab.raw.quantised_demosaicing import (
    FEWEST_ROWS,
    LARGEST_BAND,
    ROWS_AT_ONCE,
    band_edges,
    demosaic_quantised,
)
from tests.base import BaseTester

LOCAL = [
    (letters, name)
    for letters, kind in (("RGGB", "Bayer"), ("GBRG", "Bayer"), ("GMYC", "four-colour"))
    for name in LIBRAW[kind]
    if name in LIBRAW_LOCAL
]
ONE_COUNT = 1 / 65535


def thrice(counts):
    """A demosaicing that sees one colour: the value itself, its half, and nothing."""
    return np.stack([counts, counts // 2, np.zeros_like(counts)], -1)


class TestInWholeNumbers(BaseTester):
    @pytest.fixture
    def small_bands(self, monkeypatch):
        monkeypatch.setattr(quantised_demosaicing, "LARGEST_BAND", 64 * 48)

    @pytest.mark.parametrize(("letters", "name"), LOCAL)
    def test_feature_bands_are_the_whole_to_the_last_bit(self, letters, name, small_bands, monkeypatch):
        """Noise, in which every sample that a method looks at counts; four bands, of 64 to 80 rows."""
        mosaic = torch.rand(1, 301, 47) * 1.5 - 0.25
        edges = band_edges(301, 47, torch.get_num_threads())
        assert len(edges) == 5
        bands = demosaic(mosaic, *filter_tile(letters), f"libraw_{name}")
        monkeypatch.setattr(demosaicing, "LIBRAW_LOCAL", ())
        assert torch.equal(bands, demosaic(mosaic, *filter_tile(letters), f"libraw_{name}"))

    def test_feature_without_its_reach_a_band_differs(self, small_bands, monkeypatch):
        mosaic = torch.rand(1, 301, 47)
        whole = demosaic(mosaic, *filter_tile("RGGB"), "libraw_ahd")
        monkeypatch.setattr(demosaicing, "LIBRAW_REACH", 0)
        assert not torch.equal(demosaic(mosaic, *filter_tile("RGGB"), "libraw_ahd"), whole)

    def test_feature_values_come_back_to_half_a_step(self):
        mosaic = torch.rand(2, 130, 8) * 3 - 1
        image = demosaic_quantised(mosaic, thrice, torch.eye(3), 0)
        step = float(mosaic.max() - mosaic.min()) * ONE_COUNT
        assert (image[:, 0] - mosaic).abs().max() <= 0.505 * step
        low = float(mosaic.min())
        assert (image[:, 1] - (mosaic + low) / 2).abs().max() <= 0.755 * step  # of whole numbers, rounded down
        assert (image[:, 2] - low).abs().max() < 1e-6

    @pytest.mark.parametrize(("letters", "name"), [("BGGR", "libraw_ahd"), ("GRBG", "libraw_vng")])
    def test_feature_the_matrix_on_the_way_back_is_the_matrix_afterwards(self, letters, name, dtype, monkeypatch):
        """By float64 from the same colours: a twentieth of a count of 16 bits, or the dtype's own last bit."""
        mosaic = torch.rand(1, 40, 50, dtype=dtype) * 1.25 - 0.125
        matrix = torch.tensor([[1.6, -0.3, -0.3], [-0.2, 1.5, -0.3], [0.02, -0.48, 1.46]])
        tile, colors = filter_tile(letters)
        image = demosaic(mosaic, tile, colors, name, matrix)

        def unmixed(mosaic, call, _, reach):
            return demosaic_quantised(mosaic, call, torch.eye(3), reach)

        monkeypatch.setattr("kornia_tidy.lab.raw.demosaic.demosaic_quantised", unmixed)
        plain = demosaic(mosaic, tile, colors, name, matrix)
        wanted = torch.einsum("ij,jhw->ihw", matrix.double(), plain.double())
        assert image.dtype == dtype
        assert (image - wanted).abs().max() < 0.05 * ONE_COUNT

    def test_feature_the_matrix_takes_four_colours_to_three(self):
        levels = torch.tensor([0.2, 0.4, 0.6, 0.8])
        tile, colors = filter_tile("GMYC")
        mosaic = levels[torch.tensor(tile)].repeat(20, 20)[None]
        matrix = torch.tensor([[1.0, 0, 0, 0], [0, 0.5, 0.5, 0], [0.25, 0.25, 0.25, 0.25]])
        for method in ("bilinear", "libraw_vng"):
            image = demosaic(mosaic, tile, colors, method, matrix)
            assert (image - (matrix @ levels)[:, None, None]).abs().max() < ONE_COUNT

    @given(st.integers(1, 5000), st.integers(1, 9000), st.integers(1, 16))
    def test_feature_bands_cover_a_picture_once(self, height, width, threads):
        edges = band_edges(height, width, threads)
        assert (edges[0], edges[-1]) == (0, height)
        rows = [bottom - top for top, bottom in itertools.pairwise(edges)]
        assert all(edge % ROWS_AT_ONCE == 0 for edge in edges[:-1])
        if len(rows) > 1:
            assert min(rows) > FEWEST_ROWS - ROWS_AT_ONCE
        if height >= 2 * FEWEST_ROWS * threads:
            assert len(rows) >= threads
            assert max(rows) * width <= LARGEST_BAND + ROWS_AT_ONCE * width or min(rows) < 2 * FEWEST_ROWS

    def test_feature_a_low_picture_is_one_band_which_libraw_takes(self):
        assert band_edges(127, 1 << 20, 4) == [0, 127]
        assert min(np.diff(band_edges(1030, 2**21, 7))) + LIBRAW_REACH > 22

    @pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
    def test_exception_not_finite(self, value):
        mosaic = torch.rand(1, 8, 8)
        mosaic[0, 3, 4] = value
        with pytest.raises(ValueError, match=f"mosaic must be finite, got {value}"):
            demosaic_quantised(mosaic, thrice, torch.eye(3))

    def test_exception_of_a_thread_comes_here(self):
        def fails(counts):
            raise RuntimeError(f"no {counts.shape}")

        with pytest.raises(RuntimeError, match=r"no \(8, 8\)"):
            demosaic_quantised(torch.rand(1, 8, 8), fails, torch.eye(3))

    def test_cardinality_half_precision(self):
        mosaic = torch.rand(3, 10, 12, dtype=torch.float16)
        image = demosaic_quantised(mosaic, thrice, torch.eye(3))
        assert (image.shape, image.dtype) == ((3, 3, 10, 12), torch.float16)
        assert (image[:, 0] - mosaic).abs().max() < 1e-3

    def test_gradcheck_of_the_matrix_after_methods_of_real_numbers(self):
        matrix = torch.tensor([[1.0, 0.5, 0], [0, 1, 0], [0.5, 0, 2]])
        self.gradcheck(
            lambda mosaic: demosaic(mosaic, *filter_tile("GBRG"), "bilinear", matrix), (torch.rand(2, 1, 4, 6),)
        )
