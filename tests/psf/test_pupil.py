"""Gaps between the pixels of a modulator: integrated as exactly as the pixels, against brute force."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from kornia_tidy import DwellTimes, SpatialLightModulator, Spectrum, TiDyOptics
from kornia_tidy.optics import circular_aperture
from kornia_tidy.psf import exact_psf_bank
from kornia_tidy.psf.pupil import Pupil, gapped_cells, pupil_field
from tests.base import BaseTester


def brute_force(
    phase: np.ndarray, amplitude: np.ndarray, side: int, samples: int, psi: float, step: float, window: int
):
    """Midpoint samples of the pupil with ``side`` of ``samples`` modulating in each pixel; each sensor pixel 12x12."""
    size, sub = len(phase), 12
    n = size * samples
    x = ((np.arange(n) + 0.5) / samples - size / 2) * (2.3 / size)
    gap = (samples - side) // 2
    active = np.tile((np.arange(samples) >= gap) & (np.arange(samples) < gap + side), size)
    fine = np.kron(phase, np.ones((samples, samples))) * (active[:, None] & active)
    field = np.kron(amplitude, np.ones((n // len(amplitude),) * 2)) * np.exp(
        1j * (fine + psi * (x[:, None] ** 2 + x**2))
    )
    u = (np.arange(window * sub) - (window * sub - 1) / 2) * step / sub
    kernel = np.exp(-2j * np.pi * u[:, None] * x) * (2.3 / n)
    light = np.abs(kernel @ field @ kernel.T) ** 2 * (step / sub) ** 2
    return light.reshape(window, sub, window, sub).sum((1, 3)) / ((amplitude**2).sum() * (2.3 / len(amplitude)) ** 2)


class TestPupilField(BaseTester):
    @pytest.mark.parametrize("highest", [1.0, 1e2, 1e4])
    @pytest.mark.parametrize("dispersion", [1.0, 0.8652, 1.1333])
    def test_feature_thousands_of_waves_lose_no_digit(self, highest, dispersion):
        """Angles of at most pi are rounded to float32 once, cosine and sine to at most two units of round-off."""
        phase = (highest * torch.randn(1, 64, 64)).float()
        found = pupil_field(phase, torch.ones(64, 64), dispersion)
        angle = phase.double() * dispersion
        error = (found - torch.complex(angle.cos(), angle.sin())).abs().max()
        assert float(error) <= (math.pi + 2) * math.sqrt(2) * torch.finfo(torch.float32).eps / 2

    def test_gradcheck_across_whole_waves(self):
        phase = torch.tensor([[[math.pi - 1e-9, math.pi + 1e-9], [-3 * math.pi, 1e4]]], dtype=torch.float64)
        self.gradcheck(lambda p: torch.view_as_real(pupil_field(p, torch.ones(2, 2), 1.1)), (phase.requires_grad_(),))


class TestFillFactor(BaseTester):
    @pytest.mark.parametrize("per_pixel", [1, 2])
    @pytest.mark.parametrize("psi", [0.0, -15.0])
    def test_feature_equals_brute_force(self, per_pixel, psi):
        size, samples, side = 11, 40, 32
        phase = np.random.default_rng(0).uniform(0, 2 * np.pi, (size, size))
        amplitude = circular_aperture(size * per_pixel, 2.3 / size / per_pixel)
        pupil = Pupil(amplitude, 2.3 / size / per_pixel, fill_factor=(side / samples) ** 2)
        step, window = 0.2, 21
        one = torch.ones(1, dtype=torch.float64)
        bank = exact_psf_bank(
            torch.from_numpy(phase)[None], one, pupil, Spectrum.monochrome(), [1.0], [psi], step * 530e-9, window, 1e-6
        )
        expected = brute_force(phase, amplitude.numpy(), side, samples, psi, step, window)
        assert np.abs(bank.psfs[0, 0].numpy() - expected).sum() / expected.sum() < 3e-3

    def test_feature_a_half_wave_leaves_the_unmodulated_light_on_the_axis(self):
        """All pixels at phase phi: the mean field over a pixel is F exp(i phi) + 1 - F, alone near the axis."""
        fill, phi = 0.81, 2.0
        amplitude = torch.ones(23, 23, dtype=torch.float64)
        phase = torch.full((1, 23, 23), phi, dtype=torch.float64)
        centre = [
            exact_psf_bank(
                phase, torch.ones(1), Pupil(amplitude, 0.1, f), Spectrum.monochrome(), [1.0], [0.0], 1e-9, 1, 1e-9
            ).psfs.item()
            for f in (1.0, fill)
        ]
        mean = abs(fill * complex(math.cos(phi), math.sin(phi)) + 1 - fill) ** 2
        assert centre[1] / centre[0] == pytest.approx(mean, rel=1e-6)

    def test_feature_spans_cover_the_pixels_and_their_middles(self):
        spans = gapped_cells(6, 3, 0.25)
        lengths = spans[1] - spans[0]
        assert float(lengths[6:].sum()) == 6
        self.assert_close(lengths[:6], torch.tensor([0.25, 1.0, 0.25] * 2, dtype=torch.float64))

    @pytest.mark.filterwarnings("ignore:the paper's 23x23 pupil")
    def test_exception_the_paper_has_no_gaps(self):
        with pytest.raises(ValueError, match=r"fidelity 'paper' .* got a fill_factor of 0\.9"):
            TiDyOptics(modulator=SpatialLightModulator(DwellTimes(), fill_factor=0.9), fidelity="paper")


class TestDiameter(BaseTester):
    @pytest.mark.parametrize("size", [23, 24, 46])
    def test_feature_the_autocorrelation_ends_there(self, size):
        """Of the disc and of cells open at random: of the amplitude in a 5th of a cell, lags but the last are there."""
        for amplitude in (circular_aperture(size), (torch.rand(size, size) > 0.98).double()):
            amplitude[0, 3] = 0.5
            fine, fifths = amplitude.repeat_interleave(5, 0).repeat_interleave(5, 1), 5
            spectrum = torch.fft.rfft2((fine > 0).double(), s=(2 * 5 * size, 2 * 5 * size))
            lags = torch.fft.irfft2(spectrum.abs().square(), s=(2 * 5 * size, 2 * 5 * size)) > 0.5
            y, x = (lag - 10 * size * (lag >= 5 * size) for lag in lags.nonzero().double().unbind(1))
            # Between samples in the middles of fifths; their edges are a fifth further apart along both axes.
            farthest = float(torch.hypot(y.abs() + 1.0, x.abs() + 1.0).max()) / fifths
            assert Pupil(amplitude, 0.1).diameter == pytest.approx(0.1 * farthest, rel=1e-12)

    def test_feature_one_cell_has_its_diagonal(self):
        assert Pupil(torch.ones(1, 1), 0.5).diameter == pytest.approx(0.5 * math.sqrt(2))
