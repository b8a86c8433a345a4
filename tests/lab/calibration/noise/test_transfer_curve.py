"""Noise variance in blocks: blocks of pure noise give it without bias, and blocks with texture are rejected."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from kornia_tidy.lab.calibration.noise.transfer_curve import spatial_points, temporal_points
from kornia_tidy.lab.raw import RawCapture
from tests.base import BaseTester
from tests.lab.calibration.noise.flats import flat

XTRANS = "GGRGGBGGBGGRBRGRBGGGBGGRGGRGGBRBGBRG"


def gaussian(seed, sigma=20.0, shape=(1, 512, 512), level=2000.0):
    counts = np.random.default_rng(seed).normal(level, sigma, shape).round().astype(np.int32)
    return torch.from_numpy(counts)


def pooled(points):
    """Return the mean variance over all points, and its standard error for pure noise."""
    samples = sum(point.samples for point in points)
    return sum(point.variance * point.samples for point in points) / samples, math.sqrt(2 / samples)


class TestSpatialPoints(BaseTester):
    @pytest.mark.parametrize(
        ("pattern", "channels", "names"),
        [("RGGB", 1, "RGB"), ("GMYC", 1, "GMYC"), (XTRANS, 1, "GRB"), (None, 1, "L"), (None, 3, "RGB")],
    )
    def test_feature_what_is_kept_of_noise_has_its_variance(self, pattern, channels, names):
        raw = RawCapture.from_counts(gaussian(0, shape=(channels, 512, 512)), pattern, black=256, white=4095)
        points = spatial_points(raw)
        assert {point.channel for point in points} == set(names)
        variance, error = pooled(points)
        assert abs(variance / (20.0**2 + 1 / 12) - 1) < 4 * 1.26 * error  # a median has 1.25 times the error
        kept = sum(point.samples for point in points) / (61 if len(pattern or "four") == 4 else 13)
        blocks = channels * 512**2 / (64 if len(pattern or "four") == 4 else 16)
        assert kept / blocks > 0.8

    def test_feature_gradients_do_not_count(self):
        ramp = torch.linspace(0, 2000, 512).round().int() - 1000
        raw = RawCapture.from_counts(gaussian(1, sigma=5.0) + ramp, "RGGB", black=256, white=4095)
        points = spatial_points(raw)
        assert len(points) > 20
        assert all(
            abs(point.variance / (25 + 1 / 12) - 1) < 5 * 1.26 * math.sqrt(2 / point.samples) for point in points
        )

    @pytest.mark.parametrize("period", [3.0, 7.3, 25.0])
    def test_feature_texture_is_left_out(self, period):
        """The right half has a weave of twice the noise's amplitude, so only the left half is measured."""
        x = torch.arange(512)
        weave = 40 * torch.sin(2 * math.pi * x / period) * torch.sin(2 * math.pi * x[:, None] / period)
        texture = torch.where(x >= 256, weave, torch.zeros(())).round().int()
        points = spatial_points(RawCapture.from_counts(gaussian(2) + texture, "RGGB", black=256, white=4095))
        variance, error = pooled(points)
        assert abs(variance / (20.0**2 + 1 / 12) - 1) < 6 * 1.26 * error
        kept = sum(point.samples for point in points) / 61
        assert 0.35 < kept / 4096 < 0.55

    @pytest.mark.parametrize(("white", "level"), [(2030, 2000.0), (4095, 4080.0)])
    def test_feature_clipped_levels_are_left_out(self, white, level):
        counts = gaussian(4, level=level).clamp(max=white)
        counts[..., :256] = gaussian(5, level=1000.0)[..., :256]
        points = spatial_points(RawCapture.from_counts(counts, "RGGB", black=256, white=4095))
        assert points
        assert all(point.level + 256 < 1010 for point in points)

    def test_feature_counts_cut_at_zero_are_left_out(self):
        counts = gaussian(6, level=10.0).clamp(min=0)
        assert spatial_points(RawCapture.from_counts(counts, "RGGB", black=0, white=4095)) == []

    def test_cardinality_less_than_a_block(self):
        assert spatial_points(RawCapture.from_counts(torch.zeros(1, 6, 6), "RGGB", black=0, white=4095)) == []


class TestTemporalPoints(BaseTester):
    @pytest.mark.parametrize("frames", [2, 3, 7])
    def test_feature_variance_of_a_stack_is_numpys(self, frames):
        """Against the variance of each pixel over time, for a scene with texture everywhere."""
        rng = np.random.default_rng(0)
        scene = rng.uniform(500, 3500, (1, 256, 256))
        stack = np.stack([(scene + rng.normal(0, 12, scene.shape)).round() for _ in range(frames)]).astype(np.int32)
        raws = [RawCapture.from_counts(torch.from_numpy(frame), "RGGB", black=256, white=4095) for frame in stack]
        variance, error = pooled(temporal_points(raws))
        assert variance == pytest.approx(float(stack.var(0, ddof=1).mean()), rel=3 * error)
        assert abs(variance / (144 + 1 / 12) - 1) < 4 * error

    def test_feature_light_may_drift(self):
        rng = np.random.default_rng(0)
        still = temporal_points([flat(rng, 2000.0, 2.0, 6.0) for _ in range(2)])
        drifting = temporal_points([flat(rng, 2000.0 * k, 2.0, 6.0) for k in (1.0, 1.01)])
        assert pooled(drifting)[0] == pytest.approx(pooled(still)[0], rel=0.03)

    def test_feature_what_moved_is_left_out(self):
        """The right half of the scene moves by two pixels between the captures, so its blocks are rejected."""
        rng = np.random.default_rng(0)
        blob = torch.from_numpy(rng.normal(0, 1, (1, 1, 512, 520))).float()
        blob = torch.nn.functional.avg_pool2d(blob, 9, 1, 4)[0] * 2000
        raws = []
        for shift in (0, 2):
            scene = blob[..., shift : 512 + shift].clone()
            scene[..., :256] = blob[..., :256]
            raws.append(RawCapture.from_counts(gaussian(8 + shift) + scene.round().int(), "RGGB", 256, 4095))
        naive = float((raws[0].counts - raws[1].counts).double().var() / 2)
        assert naive > 2 * 400
        variance, _ = pooled(temporal_points(raws))
        assert variance == pytest.approx(400, rel=0.03)
