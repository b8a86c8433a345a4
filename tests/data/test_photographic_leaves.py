"""Photographic leaves: reproducible, anti-aliased in linear light, and with the statistics of photographs."""

from __future__ import annotations

import sys

import numpy as np
import pytest
import torch
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb

from kornia_tidy.data import PhotographicLeaves, dead_leaves, photographic_leaves
from kornia_tidy.data.photographic_textures import ILLUMINATION_CELLS, TO_RGB, spline_weights
from tests.base import BaseTester

MODULE = sys.modules["kornia_tidy.data.photographic_leaves"]  # of which the package shows the function


@pytest.fixture(scope="module")
def scenes():
    """Linear light of 16 scenes of 128 x 128 pixels."""
    leaves = PhotographicLeaves(16, 128, 128, seed=3)
    return rgb_to_linear_rgb(torch.stack([leaves[i]["image"] for i in range(16)]))


def power_exponent(light, least):
    """Slope of the mean log power over log frequency, above a frequency in cycles a pixel."""
    side = light.shape[-1]
    window = np.hanning(side)[:, None] * np.hanning(side)
    frequency = np.hypot(np.fft.fftfreq(side)[:, None], np.fft.fftfreq(side)[None])
    edges = np.geomspace(least, 0.5, 9)
    rows = []
    for picture in light.mean(1).numpy():
        power = np.abs(np.fft.fft2((picture - picture.mean()) * window)) ** 2
        sums, counts = (np.histogram(frequency, edges, weights=w)[0] for w in (power, np.ones_like(power)))
        rows.append(np.log(sums / counts))
    return np.polyfit(np.log(np.sqrt(edges[1:] * edges[:-1])), np.mean(rows, 0), 1)[0]


class TestPhotographicLeaves(BaseTester):
    def test_feature_power_falls_as_in_photographs_and_faster_than_in_dead_leaves(self, scenes):
        """f^-2.9 in linear light of photographs; a spread of 0.3 was measured over sets of eight of them."""
        assert -3.8 < power_exponent(scenes, 1 / 16) < -2.5
        sharp = torch.stack([dead_leaves(128, 128, num_leaves=64, seed=seed)[0] for seed in range(16)])
        assert power_exponent(rgb_to_linear_rgb(sharp), 1 / 16) > power_exponent(scenes, 1 / 16) + 0.4

    def test_feature_light_has_the_mean_and_spread_of_photographs(self, scenes):
        """.24 to .29 and .23 in sets of photographs, whose exposures differ by a factor of two and more."""
        assert 0.15 < scenes.mean() < 0.35
        assert 0.15 < scenes.std() < 0.3

    def test_feature_pixels_at_outlines_are_averages_of_linear_light(self, monkeypatch):
        """A picture of four times the samples a pixel, averaged in linear light by the test."""
        monkeypatch.setattr(MODULE, "SOFT_SHARE", 0.0)
        image, _ = photographic_leaves(24, 32, seed=4)
        monkeypatch.setattr(MODULE, "averaged", lambda light: light)
        fine, _ = photographic_leaves(24, 32, seed=4)
        assert fine.shape == (3, 48, 64)
        expected = linear_rgb_to_rgb(torch.nn.functional.avg_pool2d(rgb_to_linear_rgb(fine[None]), 2))[0]
        self.assert_close(image, expected, rtol=0, atol=1e-5)

    def test_feature_half_of_the_scenes_are_softened(self, monkeypatch):
        whole = [photographic_leaves(24, 24, seed=seed)[0] for seed in range(16)]
        monkeypatch.setattr(MODULE, "SOFT_SHARE", 0.0)
        sharp = [photographic_leaves(24, 24, seed=seed)[0] for seed in range(16)]
        soft = [one.diff(dim=1).square().sum() < 0.999 * other.diff(dim=1).square().sum()
                for one, other in zip(whole, sharp, strict=True)]  # fmt: skip
        same = [torch.equal(one, other) for one, other in zip(whole, sharp, strict=True)]
        assert sum(soft) + sum(same) == 16
        assert 2 < sum(same) < 14  # 8 +- 2

    def test_convention_depth_is_that_of_a_surface_and_never_mixed(self):
        """One or two leaves that do not slant, before the background: no other depths at their outlines."""
        few = 0
        for seed in range(30):
            depths = photographic_leaves(12, 12, depth_range=(0.5, 8.0), seed=seed)[1].unique()
            few += len(depths) <= 3
        assert few >= 8  # two thirds of leaves do not slant; any mixing would give a value for each pixel of an outline


class TestColours(BaseTester):
    def test_convention_the_axes_are_luminance_red_over_blue_and_green_over_magenta(self):
        red, green, blue = (np.array([0.3, -0.7, 0.2]) @ TO_RGB).T
        assert (red + green + blue) / 3 == pytest.approx(0.3)
        assert red - blue == pytest.approx(-0.7)
        assert green - (red + blue) / 2 == pytest.approx(0.2)

    def test_feature_spline_weights_sum_to_one_and_give_straight_lines_back(self):
        weights = spline_weights(50)
        assert weights.shape == (50, ILLUMINATION_CELLS + 3)
        assert weights.sum(1) == pytest.approx(np.ones(50))
        line = weights @ (np.arange(ILLUMINATION_CELLS + 3) - 1)
        assert line == pytest.approx((np.arange(50) + 0.5) / 50 * ILLUMINATION_CELLS)
