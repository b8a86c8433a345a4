"""Leaf textures: each pixel is shaded from its own leaf alone."""

from __future__ import annotations

import numpy as np
import pytest

from kornia_tidy.data.leaf_textures import TEXTURES, Leaves, make_noise_tile, make_script_tile, paint_leaves
from tests.base import BaseTester


def paint(index: np.ndarray, seed: int) -> np.ndarray:
    """Two leaves side by side, 64 px high."""
    center = np.array([[16.0, 32.0], [48.0, 32.0]])
    flat = np.zeros(2), np.zeros((2, 2)), np.zeros((2, 1, 2))
    leaves = Leaves(center, np.array([40.0, 25.0]), np.array([0.3, 2.0]), *flat)
    return paint_leaves(index.astype(np.int32), leaves, np.random.default_rng(seed))


class TestPaintLeaves(BaseTester):
    @pytest.mark.parametrize("seed", range(8))
    def test_convention_no_colour_crosses_an_outline(self, seed):
        """The picture of two leaves is cut from the pictures of each alone: nothing is mixed at the edge."""
        index = np.indices((64, 64)).sum(0) > 60
        first, second = paint(np.zeros((64, 64)), seed), paint(np.ones((64, 64)), seed)
        np.testing.assert_allclose(paint(index, seed), np.where(index[..., None], second, first), atol=1e-6)
        assert np.abs(first - second).mean() > 0.02

    @pytest.mark.parametrize("texture", dict.fromkeys(TEXTURES), ids=lambda f: f.__name__)
    def test_feature_textures_stay_between_their_two_colours(self, texture):
        """Weights within [0, 1] that use most of that range, at pixels far and near and for large and small leaves."""
        rng = np.random.default_rng(0)
        along, across = rng.uniform(-300, 300, (2, 20000)).astype(np.float32)
        size = rng.uniform(1, 300, 20000).astype(np.float32)
        style = rng.random((3, 20000), dtype=np.float32)
        value = texture(
            along, across, size, style, make_noise_tile(rng) if texture.__name__ != "_script" else make_script_tile(rng)
        )
        assert value.shape == (20000,)
        assert value.min() >= 0
        assert value.max() <= 1
        assert np.ptp(value) > 0.8

    def test_feature_the_noise_tile_repeats_without_a_seam(self):
        """The step from its last column to its first is as large as any other."""
        tile = make_noise_tile(np.random.default_rng(0))
        inside = np.abs(np.diff(tile, axis=1)).mean()
        assert np.abs(tile[:, 0] - tile[:, -1]).mean() < 1.3 * inside
        assert np.abs(tile[0] - tile[-1]).mean() < 1.3 * inside
