from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from kornia_tidy import DefocusRange, Fidelity, PixelwiseMask, PSFBank, SensorNoise
from kornia_tidy.data import PHOTOGRAPHS, SceneStatistics
from kornia_tidy.design import crlb, design, restoration_error
from kornia_tidy.design.objectives import point_error
from kornia_tidy.psf import FieldBank, PSFModel
from tests.base import BaseTester
from tests.design.published_setting import design_fisher_mask

COARSE = Fidelity("coarse", pixel_tolerance=0.1, window=33, stray_light="discard")


def bank_of(*psfs):
    """Return a PSF bank of one channel in float64."""
    stack = torch.stack([torch.as_tensor(psf).double() for psf in psfs])[:, None]
    return PSFBank(stack, torch.arange(len(psfs)).double(), stack.sum((2, 3)))


def impulse(size=9, strength=1.0):
    psf = torch.zeros(size, size, dtype=torch.float64)
    psf[size // 2, size // 2] = strength
    return psf


class TestDesign(BaseTester):
    def test_feature_finds_the_least_of_a_parabola(self):
        masks = PixelwiseMask(1, initial="flat")
        history = design(masks, lambda: (masks.phase - 0.5).square().mean(), iterations=200, lr_metres=5e-9)
        assert history[0] == pytest.approx(0.25)
        assert len(history) == 200
        self.assert_close(masks.phase.detach(), torch.full((1, 23, 23), 0.5), rtol=0, atol=1e-3)

    def test_feature_the_first_step_is_of_the_learning_rate(self):
        masks = PixelwiseMask(1, initial="flat")
        design(masks, lambda: (masks.phase - 9).square().mean(), iterations=1, lr_metres=1e-8)
        self.assert_close(masks.heights().detach() * 1e8, torch.ones(1, 23, 23))

    def test_feature_the_bound_of_a_lens_falls(self):
        """The design works for two masks in three colours too, not only for one mask in the published setting."""
        masks = PixelwiseMask(2)
        lens = PSFModel(masks, DefocusRange(-10, 10), fidelity=COARSE.replace(window=17, layer_spacing=5.0))
        history = design(masks, lambda: crlb(lens).mean(), iterations=15, lr_metres=3e-8)
        assert history[-1] < 0.8 * history[0]

    @pytest.mark.parametrize(("name", "options"), [("iterations", {"iterations": 0}), ("lr_metres", {"lr_metres": -1})])
    def test_exception_counts_and_rates(self, name, options):
        masks = PixelwiseMask(1)
        with pytest.raises(ValueError, match=f"{name} must be positive"):
            design(masks, masks.phase.sum, **options)


class TestFisherDesign(BaseTester):
    @pytest.mark.takes_seconds
    def test_feature_beats_the_published_mask_by_far(self):
        """The mask published with PhaseCam3D has 0.0785 rad in the same setting; half the steps suffice here."""
        _, bound = design_fisher_mask(seed=0, iterations=75)
        assert bound < 0.072

    def test_feature_seeds_repeat_and_differ(self):
        (first, one), (again, same), (_, other) = (design_fisher_mask(seed=s, iterations=3) for s in (0, 0, 1))
        assert torch.equal(first.phase, again.phase)
        assert one == same != other


class TestPointError(BaseTester):
    def test_feature_literals(self):
        assert float(point_error(bank_of(impulse()))) == 0
        assert float(point_error(bank_of(impulse(), torch.zeros(9, 9)))) == 0.5
        even = torch.full((9, 9), 1 / 81)
        assert float(point_error(bank_of(even))) == pytest.approx(1 - 1 / 81)


class TestRestorationError(BaseTester):
    @pytest.mark.parametrize("veiled", [False, True])
    def test_feature_in_linear_light_is_the_error_of_the_best_filter_written_out(self, veiled):
        """For each frequency in NumPy: the minimum of E|1 - G H|² S + |G|² noise² over complex G."""
        bank, scenes = self._dim_bank(veiled), SceneStatistics(2.4, 0.1, 0.4, spread=0.3, depths=(0.6, 0.4))
        share, transfer, spectrum, best = self._best_filter(bank, scenes, 0.2 * 0.3)
        error = (share * np.abs(1 - best * transfer) ** 2).sum(0) * spectrum + np.abs(best) ** 2 * (0.2 * 0.3) ** 2
        assert float(restoration_error(bank, 0.2, scenes)) == pytest.approx(error.mean() / 0.3**2, rel=1e-9)

    def test_feature_over_the_field_it_is_the_mean_over_the_places(self):
        banks = self._dim_bank(True), self._dim_bank(True)
        psfs, energy, veil = (
            torch.stack([getattr(bank, part) for bank in banks]) for part in ("psfs", "energy", "veil")
        )
        whole = FieldBank(psfs, banks[0].defocus, torch.zeros(2, 2), energy, torch.ones_like(energy), veil)
        one, other = (float(restoration_error(bank)) for bank in banks)
        assert float(restoration_error(whole)) == pytest.approx((one + other) / 2, rel=1e-9)
        assert one != other

    @pytest.mark.parametrize("sensor", [SensorNoise(0.04), SensorNoise(0.01, full_well=200, dark=3)])
    def test_feature_in_srgb_it_is_the_sum_over_all_pairs_of_pixels(self, sensor):
        """What the filter leaves at each pixel is multiplied by the light around, summed over pairs of pixels."""
        scenes = SceneStatistics(2.4, 0.1, 0.4, spread=0.3, depths=(0.6, 0.4), shade=0.4, shade_size=3)
        bank = self._dim_bank(True)
        read, whole = (float(sensor.std(torch.tensor(x).double()) ** 2) for x in (0.0, 0.4))
        share, transfer, spectrum, best = self._best_filter(bank, scenes, whole**0.5)
        y = np.minimum(np.arange(14), 14 - np.arange(14))
        around = 1 - 0.6 * np.exp(-((np.hypot(y[:, None], y) / 3) ** 0.75))
        covariance = np.fft.ifft2(spectrum).real
        lags = (np.arange(14)[:, None] - np.arange(14)) % 14
        error = 0.0
        for weight, each in zip(share.ravel(), transfer, strict=True):
            left = np.fft.ifft2(best * each - 1).real
            pairs = covariance[lags[:, None, :, None], lags[None, :, None, :]]
            error += weight * np.einsum("ij,ijkl,kl", left * around, pairs, left * around)
            error += weight * (0.4 * (left * (around - 1)).sum()) ** 2
        psf = np.fft.ifft2((share * transfer).sum(0)).real
        light = np.array([[(psf * np.roll(around, (-i, -j), (0, 1))).sum() for j in range(14)] for i in range(14)])
        error += (np.fft.ifft2(best).real ** 2 * (read + (whole - read) * light)).sum()
        mean_image = (0.3 * 0.4) ** 2 + (0.4 * 0.6) ** 2
        assert float(restoration_error(bank, sensor, scenes)) == pytest.approx(error / mean_image, rel=1e-9)

    @staticmethod
    def _dim_bank(veiled):
        bank = bank_of(*0.02 * torch.rand(3, 7, 7, dtype=torch.float64))
        veil = torch.rand(3, 1, dtype=torch.float64) if veiled else None
        return PSFBank(bank.psfs, bank.defocus, bank.energy, veil)

    @staticmethod
    def _best_filter(bank, scenes, noise):
        """Return shares of depth, transfer functions, spectrum and filter on a plane of 14 pixels, by NumPy."""
        f = np.fft.fftfreq(14)
        spectrum = scenes.spectrum(torch.from_numpy(np.hypot(f[:, None], f))).numpy()
        spectrum[0, 0] = 0
        spectrum[0, 0] = 14**2 * scenes.spread**2 - spectrum.sum()
        plane = np.zeros((3, 14, 14))
        plane[:, :7, :7] = bank.psfs[:, 0].numpy()
        transfer = np.fft.fft2(np.roll(plane, (-3, -3), (1, 2)))
        if bank.veil is not None:
            transfer[:, 0, 0] += bank.veil[:, 0].numpy()
        share = np.array([0.3, 0.5, 0.2])[:, None, None]
        mean, power = (share * transfer).sum(0), (share * np.abs(transfer) ** 2).sum(0)
        return share, transfer, spectrum, mean.conj() * spectrum / (power * spectrum + noise**2)

    def test_feature_depths_without_pixels_do_not_count(self):
        sharp, blurred = impulse(), torch.full((9, 9), 1 / 81).double()
        far = replace(PHOTOGRAPHS, depths=(1.0, 0.0, 0.0, 0.0))
        bank = bank_of(sharp, sharp, blurred)
        assert float(restoration_error(bank, 1e-3, far)) == pytest.approx(
            float(restoration_error(bank_of(sharp), 1e-3))
        )
        assert float(restoration_error(bank, 1e-3)) > 1e-3

    @pytest.mark.parametrize("noise", [0, -1, math.inf, math.nan])
    def test_exception_noise(self, noise):
        with pytest.raises(ValueError, match="noise must be positive and finite, got"):
            restoration_error(bank_of(impulse()), noise)

    def test_gradcheck(self):
        defocus, energy = torch.arange(2.0).double(), torch.ones(2, 1).double()
        psfs = torch.rand(2, 1, 5, 5)
        self.gradcheck(lambda p: restoration_error(PSFBank(p, defocus, energy)), (psfs,))
        self.gradcheck(lambda p: point_error(PSFBank(p, defocus, energy)), (psfs,))
