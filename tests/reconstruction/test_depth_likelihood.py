"""The likelihood of depth in closed form: on textures of known spectrum, and on blank walls."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from kornia_tidy.reconstruction.depth_distribution import depth_moments
from kornia_tidy.reconstruction.depth_likelihood import (
    CONTRASTS,
    EXPONENT,
    KNEE,
    NOISE,
    depth_likelihood,
    likelihood_filters,
)
from kornia_tidy.reconstruction.truncation import SIDE, plane_of, truncated
from tests.base import BaseTester

SIZE = 96


def gaussians(window=9, dtype=torch.float32):
    """PSFs of growing width, (4, P, P)."""
    y, x = np.mgrid[:window, :window] - window // 2
    psfs = torch.from_numpy(np.stack([np.exp(-(x**2 + y**2) / (2 * s**2)) for s in (0.3, 0.8, 1.3, 1.8)])).to(dtype)
    return psfs / psfs.sum((1, 2), keepdim=True)


def power(psf, contrast):
    """Power spectrum of the captures of one depth, of SIZE by SIZE pixels, by NumPy's transform and quadrature."""
    y, x = np.fft.fftfreq(SIZE)[:, None], np.fft.fftfreq(SIZE)
    spectrum = (x**2 + y**2 + KNEE**2) ** (-EXPONENT / 2)
    radius = np.linspace(0, 0.5, 100_001)
    spectrum /= np.trapezoid(2 * np.pi * radius * (radius**2 + KNEE**2) ** (-EXPONENT / 2), radius)
    return contrast**2 * np.abs(np.fft.fft2(psf.numpy(), (SIZE, SIZE))) ** 2 * spectrum + NOISE**2


def texture(psf, contrast, seed=0):
    """Capture of a Gaussian scene at one depth, (1, 1, SIZE, SIZE)."""
    noise = np.random.default_rng(seed).standard_normal((SIZE, SIZE))
    capture = np.fft.ifft2(np.fft.fft2(noise) * np.sqrt(power(psf, contrast))).real
    return torch.from_numpy(0.5 + capture).float().view(1, 1, SIZE, SIZE)


class TestLikelihoodFilters(BaseTester):
    def test_feature_the_log_determinant_is_the_mean_log_power(self):
        """Of planes of another size: sums over frequencies converge to the integral, but for the knee."""
        psfs = gaussians(dtype=torch.float64)
        _, found = likelihood_filters(psfs)
        expected = [np.log(power(psf, contrast)).mean() for contrast in CONTRASTS for psf in psfs]
        self.assert_close(found, torch.tensor(expected), atol=0.1, rtol=0)

    def test_feature_the_right_filter_makes_noise_white(self):
        """With a variance of one; a chi-squared of n pixels has a standard error of sqrt(2 / n)."""
        filters, _ = likelihood_filters(gaussians(dtype=torch.float64))
        for index, (contrast, layer) in enumerate((a, k) for a in CONTRASTS for k in range(4)):
            capture = texture(gaussians()[layer], contrast)[0, 0].numpy()
            side = filters.shape[-1]
            kernel = np.zeros((SIZE, SIZE))
            kernel[:side, :side] = filters[index].numpy()
            white = np.fft.ifft2(np.fft.fft2(capture) * np.fft.fft2(kernel)).real
            assert white.var() == pytest.approx(1.0, abs=0.1 + 5 * math.sqrt(2) / SIZE)

    def test_exception(self):
        with pytest.raises(ValueError, match="noise must be positive"):
            likelihood_filters(gaussians(), 0.0)

    def test_gradcheck(self, device):
        self.gradcheck(likelihood_filters, (gaussians(3, torch.float64).to(device),))


class TestDepthLikelihood(BaseTester):
    @pytest.mark.parametrize("contrast", [0.06, 0.1])
    def test_feature_a_texture_is_most_likely_at_its_depth(self, contrast):
        filters = likelihood_filters(gaussians())
        for layer, psf in enumerate(gaussians()):
            likelihood = depth_likelihood(texture(psf, contrast), *filters)
            assert int(likelihood.mean((0, 2, 3)).argmax()) == layer
            assert likelihood.amax(1).abs().max() == 0

    def test_feature_a_blank_wall_has_no_depth(self):
        filters = likelihood_filters(gaussians())
        wall = 0.5 + NOISE * torch.randn(1, 1, SIZE, SIZE, generator=torch.Generator().manual_seed(0))
        unknown = depth_moments(depth_likelihood(wall, *filters))[1].mean()
        known = depth_moments(depth_likelihood(texture(gaussians()[1], 0.1), *filters))[1].mean()
        uniform = math.sqrt(5 / 36)  # of four depths
        assert unknown > 0.8 * uniform
        assert known < 0.5 * uniform

    def test_gradcheck(self, device):
        filters = [part.double().to(device) for part in likelihood_filters(gaussians(3, torch.float64), 0.1)]
        light = torch.rand(1, 1, 12, 13, device=device, dtype=torch.float64)
        self.gradcheck(lambda light: depth_likelihood(light, *filters), (light,))


class TestTruncated(BaseTester):
    def test_feature_the_middle_and_the_sum_stay(self):
        filters = torch.rand(2, 40, 40, dtype=torch.float64)
        filters[..., 5:-5, :] = filters[..., 5:-5] = 0.0  # nothing is cut off but by the fade
        cut = truncated(filters, 21)
        self.assert_close(cut.sum((-2, -1)), filters.sum((-2, -1)))
        short = torch.zeros(40, 40, dtype=torch.float64)
        short[:3, :3] = 1.0
        self.assert_close(truncated(short, 21)[10:13, 10:13], short[:3, :3])
        assert plane_of(filters[..., :5, :5]) >= SIDE * 5
