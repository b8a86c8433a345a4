"""Dead-leaves scenes: reproducible, natural in their statistics, and exact at depth edges."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from kornia_tidy.data import dead_leaves
from tests.base import BaseTester


@pytest.fixture(scope="module")
def scenes():
    """Four 256x256 scenes from 0.3 m to infinity."""
    return [dead_leaves(256, 256, depth_range=(0.3, float("inf")), seed=seed) for seed in range(4)]


class TestDeadLeaves(BaseTester):
    @pytest.mark.takes_seconds
    @pytest.mark.parametrize("num_leaves", [200, 1000])
    def test_feature_seen_depth_is_a_power_of_what_is_uniform(self, num_leaves):
        """Background exp(-3) = 5 % of the pixels; then u ** g for uniform u, however small the leaves."""
        seen = [dead_leaves(96, 96, depth_range=(0.5, 4.0), num_leaves=num_leaves, seed=s)[1] for s in range(40)]
        inverse_depth = (1 / torch.stack(seen) - 1 / 4.0) / (1 / 0.5 - 1 / 4.0)
        shown = inverse_depth[inverse_depth >= 1e-5].double()
        assert 0.03 < (inverse_depth < 1e-5).float().mean() < 0.07
        # With g log-uniform on [1, 3] the mean of u ** g is log(1.5) / log(3); likewise for its powers.
        for power, expected in ((1, math.log(1.5)), (2, math.log(9 / 7)), (0.5, math.log(9 / 5))):
            assert shown.pow(power).mean() == pytest.approx(expected / math.log(3), abs=0.04)

    def test_feature_the_far_end_is_a_background_at_infinity(self, scenes):
        """Most scenes show a little of it, and leaves beside it are at finite depths."""
        assert 0.01 < torch.stack([depth.isinf().float().mean() for _, depth in scenes]).mean() < 0.12
        for _, depth in scenes:
            assert depth[depth.isfinite()].max() > 10

    def test_feature_power_spectrum_falls_as_in_natural_images(self, scenes):
        """Radially averaged power ~ 1 / f^2 (Field 1987; Ruderman and Bialek 1994)."""
        window = np.hanning(256)[:, None] * np.hanning(256)
        frequency = np.hypot(np.fft.fftfreq(256)[:, None], np.fft.fftfreq(256)[None]).ravel()
        edges = np.geomspace(4 / 256, 0.4, 16)
        power = np.zeros(15)
        for image, _ in scenes:
            luminance = np.tensordot([0.2126, 0.7152, 0.0722], image.numpy(), 1)
            spectrum = np.abs(np.fft.fft2((luminance - luminance.mean()) * window)).ravel() ** 2
            sums, _ = np.histogram(frequency, edges, weights=spectrum)
            power += sums / np.histogram(frequency, edges)[0]
        slope = np.polyfit(np.log(np.sqrt(edges[1:] * edges[:-1])), np.log(power), 1)[0]
        assert -2.6 < slope < -1.4

    def test_convention_depth_is_not_mixed_at_edges(self):
        """One leaf in front of the background: its depth, where it does not slant, is one value up to the edge."""
        values = [dead_leaves(32, 32, num_leaves=1, seed=seed)[1].unique() for seed in range(12)]
        flat = [depths for depths in values if len(depths) == 2]
        assert len(flat) >= 5  # two thirds of leaves do not slant; any mixing would give dozens of values
        assert all(depths[1] == 10 for depths in flat)

    def test_feature_planes_are_affine_in_inverse_depth(self):
        """Away from edges the second difference of 1 / z vanishes, yet some of the picture is slanted."""
        _, depth = dead_leaves(128, 128, depth_range=(0.5, 4.0), num_leaves=40, seed=3)
        slope = (1 / depth[0].double()).diff(dim=1)
        assert (slope.abs() > 1e-5).float().mean() > 0.1
        assert ((slope.diff(dim=1).abs() < 1e-6).float().mean()) > 0.85
