"""Reliability and sparsification curves of noise with known deviation."""

from __future__ import annotations

import math

import pytest
import torch

from kornia_tidy.reconstruction.reliability import ReliabilityCurve, reliability_curve, sparsification_curve
from tests.base import BaseTester

PIXELS, BINS = 200, 10  # a side; 4000 pixels in a bin


def gaussian(seed=0):
    """Noise with a deviation that differs from row to row, as a depth map: prediction, deviation, truth."""
    noise = torch.Generator().manual_seed(seed)
    truth = torch.rand(1, 1, PIXELS, PIXELS, generator=noise)
    deviation = torch.logspace(-2, 0, PIXELS).view(1, 1, -1, 1).expand(1, 1, PIXELS, PIXELS)
    return truth + deviation * torch.randn(truth.shape, generator=noise), deviation, truth


class TestReliabilityCurve(BaseTester):
    def test_feature_calibrated_noise_is_found_as_large_as_predicted(self):
        """The standard error of a root mean square of n samples is 1 / sqrt(2 n) of it; five of them."""
        bound = 5 / math.sqrt(2 * PIXELS**2 / BINS)
        prediction, deviation, truth = gaussian()
        curve = reliability_curve(prediction, deviation, truth, bins=BINS)
        assert ((curve.found / curve.predicted - 1).abs() < bound).all()
        assert (curve.predicted.diff() > 0).all()
        assert curve.calibration_error() < bound
        halved = reliability_curve(prediction, deviation / 2, truth, bins=BINS)
        assert halved.calibration_error() == pytest.approx(1.0, abs=2 * bound)

    def test_feature_unknown_pixels_do_not_count(self):
        prediction, deviation, truth = gaussian()
        known = torch.rand(truth.shape) > 0.5
        unknown = truth.where(known, torch.nan)
        found = reliability_curve(prediction, deviation, unknown, known)
        expected = reliability_curve(*(part[known].view(1, 1, 1, -1) for part in (prediction, deviation, truth)))
        assert torch.equal(found.found, expected.found)

    @pytest.mark.parametrize("bins", [0, 7])
    def test_exception_bins(self, bins):
        maps = [torch.rand(1, 1, 2, 3)] * 3
        with pytest.raises(ValueError, match=f"bins must be from 1 to the 6 pixels of known depth, got {bins}"):
            reliability_curve(*maps, bins=bins)

    def test_feature_a_bin_that_predicts_no_error_and_has_none_is_calibrated(self):
        curve = ReliabilityCurve(torch.tensor([0.0, 0.5]), torch.tensor([0.0, 0.75]))
        assert curve.calibration_error() == 0.25
        assert ReliabilityCurve(torch.tensor([0.0]), torch.tensor([0.1])).calibration_error() > 1e6


class TestSparsificationCurve(BaseTester):
    def test_feature_it_is_the_error_of_the_surest_pixels(self):
        prediction, deviation, truth = gaussian()
        curve = sparsification_curve(prediction, deviation, truth, shares=(0.25, 1.0))
        rows = (prediction - truth)[..., : PIXELS // 4, :]
        self.assert_close(
            curve, torch.stack([rows.square().mean().sqrt(), (prediction - truth).square().mean().sqrt()])
        )

    def test_exception(self):
        maps = [torch.rand(1, 1, 2, 3)] * 3
        with pytest.raises(ValueError, match=r"shares must be above 0 and at most 1, got 1\.5"):
            sparsification_curve(*maps, shares=(0.5, 1.5))
        with pytest.raises(ValueError, match="there are none"):
            sparsification_curve(*maps, torch.zeros(1, 1, 2, 3, dtype=torch.bool), shares=(0.5,))
