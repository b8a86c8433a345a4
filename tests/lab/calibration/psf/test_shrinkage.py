from __future__ import annotations

import torch

from kornia_tidy.lab.calibration.psf.shrinkage import shrink
from tests.base import BaseTester


def spot():
    x = torch.arange(61.0, dtype=torch.float64) - 30
    light = torch.exp(-(x[:, None] ** 2 + x**2) / 8)
    return (light / light.sum())[None]


def noisy(deviation, seed):
    return spot() + deviation * torch.randn(1, 61, 61, generator=torch.Generator().manual_seed(seed)).double()


class TestShrink(BaseTester):
    def test_feature_empty_parts_lose_their_noise_and_bright_ones_keep_their_light(self):
        deviation = 2e-5
        variance = torch.full((1, 61, 61), deviation**2, dtype=torch.float64)
        before, after = noisy(deviation, 0), shrink(noisy(deviation, 0), variance)[0]
        errors = [(image - spot()).abs().sum() for image in (before, after)]
        assert errors[1] < 0.4 * errors[0]
        self.assert_close(after[0, 28:33, 28:33], before[0, 28:33, 28:33], rtol=1e-3, atol=0)

    def test_feature_faint_light_is_not_lost(self):
        """A tail of a tenth of the noise is not visible in any pixel, but its sum is preserved."""
        tail = torch.full((1, 61, 61), 2e-6, dtype=torch.float64)
        variance = torch.full_like(tail, 4e-10)
        sums = torch.stack([shrink(noisy(2e-5, seed) - spot() + tail, variance)[0].sum() for seed in range(20)])
        raw = torch.stack([(noisy(2e-5, seed) - spot() + tail).sum() for seed in range(20)])
        self.assert_close(sums, raw, rtol=0, atol=5e-4)
        self.assert_close(sums.mean(), tail.sum(), rtol=0.1, atol=0)

    def test_feature_its_error_is_as_large_as_it_says(self):
        variance = torch.full((1, 61, 61), 4e-10, dtype=torch.float64)
        errors, said = [], []
        for seed in range(20):
            psf, expected = shrink(noisy(2e-5, seed), variance)
            errors.append((psf - spot()).square())
            said.append(expected)
        ratio = torch.stack(errors).sum() / torch.stack(said).sum()
        assert 0.6 < float(ratio) < 1.6

    def test_feature_without_noise_nothing_changes(self):
        psf, expected = shrink(spot(), torch.zeros(1, 61, 61).double())
        self.assert_close(psf, spot(), rtol=0, atol=1e-12)
        assert not bool(expected.any())
