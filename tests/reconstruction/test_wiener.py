"""Wiener restoration against NumPy, its optimality, the noise it is told, and its use as a module."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from kornia_tidy import SensorNoise
from kornia_tidy.data import PHOTOGRAPHS, SceneStatistics
from kornia_tidy.reconstruction.tikhonov import BORDERS, transfer_function
from kornia_tidy.reconstruction.wiener import Wiener, transfer_moments, wiener
from tests.base import BaseTester
from tests.reconstruction.banks import make_bank, make_psfs
from tests.rounding import gamma

SCENES = SceneStatistics(2.5, 1 / 16, mean=0.4, spread=0.1, depths=(0.7, 0.3))
borders = pytest.mark.parametrize("border", BORDERS)


def shifted(psfs, rows, columns):
    """Return the transfer functions of PSFs (D, P, P) by NumPy, with their centre at the first pixel."""
    plane = np.zeros((len(psfs), rows, columns))
    radius = psfs.shape[-1] // 2
    for y in range(psfs.shape[-1]):
        for x in range(psfs.shape[-1]):
            plane[:, (y - radius) % rows, (x - radius) % columns] += psfs[:, y, x]
    return np.fft.fft2(plane)


class TestTransferMoments(BaseTester):
    @pytest.mark.parametrize("size", [(12, 15), (9, 8), (4, 3)])
    @pytest.mark.parametrize("veiled", [False, True])
    def test_feature_equal_the_moments_of_the_transfer_functions(self, size, veiled, device):
        psfs, share = make_psfs(4, 2, 7, device=device), torch.tensor([0.1, 0.2, 0.3, 0.4]).double().to(device)
        veil = torch.rand(4, 2, device=device, dtype=torch.float64) if veiled else None
        found = transfer_moments(psfs, size, share, veil)
        transfer = transfer_function(psfs, size, veil)
        weights = share[:, None, None, None]
        torch.testing.assert_close(found.mean, (weights * transfer).sum(0))
        torch.testing.assert_close(found.power, (weights * transfer.abs().square()).sum(0))


class TestWiener(BaseTester):
    @pytest.mark.parametrize("shape", [(12, 15), (9, 8)])
    def test_feature_is_the_formula_in_numpy(self, shape, device):
        psfs, share = make_psfs(3, 1, device=device), torch.tensor([0.2, 0.3, 0.5], device=device, dtype=torch.float64)
        capture = torch.rand(2, 1, *shape, device=device, dtype=torch.float64)
        transfer = shifted(psfs[:, 0].cpu().numpy(), *shape)
        weights = share.cpu().numpy()[:, None, None]
        f = np.hypot(np.fft.fftfreq(shape[0])[:, None], np.fft.fftfreq(shape[1]))
        scene = SCENES.level * (f**2 + SCENES.knee**2) ** -1.25
        best = (weights * transfer).sum(0).conj() / ((weights * np.abs(transfer) ** 2).sum(0) + 0.03**2 / scene)
        expected = np.fft.ifft2(np.fft.fft2(capture.cpu().numpy()) * best).real
        out = wiener(capture, psfs, 0.03, SCENES, depth_weights=share, border="circular")
        self.assert_close(out.cpu(), torch.from_numpy(expected), rtol=0, atol=1e-9)

    @borders
    def test_feature_white_stays_white(self, border, device):
        """To sigma^2 / S(0) and the rounding of transforms: 10 products of magnitude below 2 at each frequency."""
        bank = make_bank(3, 2, 9, device=device)
        white = torch.ones(1, 2, 40, 33, device=device, dtype=torch.float64)
        lost = 0.03**2 / float(PHOTOGRAPHS.spectrum(torch.zeros(()).double()))
        out = Wiener(0.03, border=border)(white, bank)
        # Depth-dependent PSFs of equal light: nothing else is lost.
        self.assert_close(out, white, rtol=0, atol=1.01 * lost + 100 * gamma(40, torch.float64))

    def test_gradcheck(self, device):
        capture, psfs = torch.rand(1, 2, 7, 6, device=device), make_psfs(2, 2, 3, device=device)
        sigma = torch.tensor([0.05, 0.1], device=device).view(1, 2, 1, 1)
        self.gradcheck(lambda c, p, s: wiener(c, p, s, SCENES), (capture, psfs, sigma))

    def test_exception(self, device):
        capture, psfs = torch.rand(1, 2, 8, 8, device=device), make_psfs(device=device)
        with pytest.raises(ValueError, match=r"noise must be a standard deviation of at least 0 .* got -0\.1"):
            wiener(capture, psfs, -0.1)
        with pytest.raises(ValueError, match=r"noise must be .* got nan"):
            Wiener(math.nan)
        with pytest.raises(ValueError, match=r"\(\.\.\., 1, P, P\) with P odd .* 1 channels, got \(3, 2, 5"):
            wiener(capture[:, :1], psfs, 0.1)
        with pytest.raises(ValueError, match=r"psfs must have shape \(D, C, P, P\), got \(2, 5, 5\)"):
            wiener(capture, psfs[0], 0.1)
        with pytest.raises(ValueError, match=r"capture must have shape \(B, C, H, W\), got \(2, 8, 8\)"):
            wiener(capture[0], psfs, 0.1)
        with pytest.raises(ValueError, match="border must be one of 'smooth', 'circular', got 'valid'"):
            wiener(capture, psfs, 0.1, border="valid")
        with pytest.raises(TypeError, match="statistics must be SceneStatistics such as PHOTOGRAPHS"):
            Wiener(0.1, statistics=2.0)


class TestModule(BaseTester):
    def test_feature_is_the_function_with_depths_weighted_by_the_statistics(self, device):
        capture, bank = torch.rand(2, 2, 12, 9, device=device), make_bank(4, device=device)
        share = SCENES.depth_weights(bank.defocus)
        assert share[0] > share[-1]
        expected = wiener(capture, bank.psfs, 0.02, SCENES, depth_weights=share)
        self.assert_close(Wiener(0.02, SCENES)(capture, bank), expected, rtol=0, atol=1e-6)
        flipped = wiener(capture, bank.psfs.flip((-2, -1)), 0.02, SCENES, depth_weights=share)
        self.assert_close(Wiener(0.02, SCENES, correlate=True)(capture, bank), flipped, rtol=0, atol=1e-6)

    def test_feature_a_sensor_gives_the_noise_at_the_mean_light_of_each_channel(self, device):
        capture, bank = torch.rand(2, 2, 12, 9, device=device), make_bank(device=device, dtype=torch.float32)
        capture[:, 1] *= 0.1
        sensor = SensorNoise(0.01, full_well=200)
        noise = sensor.std(capture.mean((-2, -1), keepdim=True))
        assert float(noise[0, 0] / noise[0, 1]) > 2
        self.assert_close(
            Wiener(sensor)(capture, bank), wiener(capture, bank.psfs, noise, depth_weights=None), atol=0.2
        )
        same = Wiener(0.5)(capture, bank, noise)
        self.assert_close(Wiener(sensor)(capture, bank), same, rtol=0, atol=1e-6)

    def test_feature_each_image_of_a_batch_may_have_its_own_noise(self, device):
        capture, bank = torch.rand(2, 2, 12, 9, device=device), make_bank(device=device, dtype=torch.float32)
        both = Wiener()(capture, bank, torch.tensor([0.001, 0.3], device=device).view(2, 1, 1, 1))
        for index, sigma in enumerate((0.001, 0.3)):
            self.assert_close(both[index], Wiener(sigma)(capture, bank)[index], rtol=0, atol=1e-6)

    def test_feature_the_weight_is_learnt_as_a_logarithm(self, device):
        module = Wiener(0.1, weight=0.5).to(device)
        capture, bank = torch.rand(1, 2, 12, 9, device=device), make_bank(device=device, dtype=torch.float32)
        module(capture, bank).square().sum().backward()
        assert module.log_weight.grad.isfinite()
        assert module.log_weight.grad != 0
        assert list(module.state_dict()) == ["log_weight"]
        self.assert_close(module(capture, bank), Wiener(0.1 * 0.5**0.5)(capture, bank), rtol=0, atol=1e-5)

    def test_dynamo(self, device):
        module, bank = Wiener(SensorNoise(0.01)).to(device), make_bank(device=device, dtype=torch.float32)
        capture = torch.rand(1, 2, 12, 9, device=device)
        compiled = torch.compile(module, fullgraph=True, backend="eager")
        self.assert_close(compiled(capture, bank), module(capture, bank), atol=0, rtol=0)
