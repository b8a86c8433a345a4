from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from kornia_tidy import DefocusRange, Fidelity, LearnableDwellTimes, PixelwiseMask, SpatialLightModulator, Spectrum
from kornia_tidy.optics import CubicMask, DwellTimes, SpiralMask, ThinLensCamera, ZernikeMask, circular_aperture
from kornia_tidy.optics.coded_lens import CodedLens
from kornia_tidy.optics.fisher_information import (
    PointResponse,
    crlb,
    defocus_bound,
    defocus_response,
    fisher_information,
    sampled_response,
)
from kornia_tidy.optics.materials import PMMA
from tests.base import DATA, BaseTester, needs_data

APERTURE = circular_aperture(23)
FINE = Fidelity("fine", pixel_tolerance=1e-4, window=25, stray_light="discard", double=True)


def smooth_mask(seed: int = 3, rms: float = 1.0) -> Tensor:
    """A mask without any symmetry, (1, 23, 23) radians."""
    strengths = rms / 28**0.5 * torch.randn(28, generator=torch.Generator().manual_seed(seed))
    return ZernikeMask(1, num_modes=28, initial=strengths).phase.detach().double()


class SampledCamera:
    """The published setting written out with NumPy's FFT: expected photons of a point and their derivatives."""

    def __init__(self, phase: np.ndarray, photons: float, background: float, samples: int = 64) -> None:
        self.index = np.arange(23) - 11.0
        rho2 = (self.index[:, None] ** 2 + self.index**2) / 100
        self.rho2 = np.where(rho2 <= 1 + 1e-9, rho2, 0)
        self.field = np.where(rho2 <= 1 + 1e-9, np.exp(1j * phase), 0) / 317**0.5
        self.photons, self.background, self.samples = photons, background, samples

    def expected(self, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Photons (T, M²) and derivatives (T, 3, M²) at T points (psi, x, y), the place being in pixels."""
        psi, x, y = parameters.T[..., None, None]
        column = 2 * np.pi / self.samples * self.index
        row = column[:, None]
        wave = self.field * np.exp(1j * (psi * self.rho2 + x * column + y * row))
        waves = np.stack([wave, 1j * self.rho2 * wave, 1j * column * wave, 1j * row * wave])
        light = np.fft.fft2(waves, s=(self.samples, self.samples)) / self.samples
        counts = self.photons * np.abs(light[0]) ** 2 + self.background
        slopes = 2 * self.photons * (light[0].conj() * light[1:]).real
        return counts.reshape(len(psi), -1), slopes.transpose(1, 0, 2, 3).reshape(len(psi), 3, -1)

    def bound(self, psi: float) -> float:
        counts, slopes = self.expected(np.array([[psi, 0, 0]]))
        return float(np.linalg.inv((slopes[0] / counts[0]) @ slopes[0].T)[0, 0] ** 0.5)

    def most_likely(self, images: np.ndarray, start: np.ndarray, steps: int) -> np.ndarray:
        """Maximum likelihood by Fisher scoring from the truth: the maximum that an unbiased estimate would be at."""
        found = np.tile(start, (len(images), 1))
        for _ in range(steps):
            counts, slopes = self.expected(found)
            score = np.einsum("tip,tp->ti", slopes, images / counts - 1)
            information = np.einsum("tip,tjp->tij", slopes / counts[:, None], slopes)
            step = np.linalg.solve(information, score[..., None])[..., 0]
            found = found + np.clip(step, -1, 1)
        return found


def errors_of_maximum_likelihood(camera: SampledCamera, psi: float, trials: int, steps: int) -> np.ndarray:
    generator, truth = np.random.default_rng(int(psi) + 100), np.array([psi, 0.0, 0.0])
    counts, _ = camera.expected(truth[None])
    batches = [generator.poisson(counts[0], (100, counts.shape[1])) for _ in range(trials // 100)]
    return np.concatenate([camera.most_likely(images, truth, steps) for images in batches])[:, 0] - psi


class TestBoundIsReached(BaseTester):
    @pytest.mark.parametrize("psi", [-8.0, 0.0, 8.0])
    def test_feature_maximum_likelihood_scatters_by_the_bound(self, psi):
        """1000 images of 3000 photons: the standard deviation itself is known to 2 %."""
        camera = SampledCamera(smooth_mask()[0].numpy(), 3000, 5)
        errors = errors_of_maximum_likelihood(camera, psi, 1000, steps=3)
        bound = float(defocus_bound(fisher_information(sampled_response(smooth_mask(), APERTURE, [psi]))))
        assert errors.std() == pytest.approx(bound, rel=0.1)
        assert abs(errors.mean()) < bound / 5  # so the bound for unbiased estimates is the one that counts
