from __future__ import annotations

import torch

from kornia_tidy.data import PHOTOGRAPHS
from kornia_tidy.design.closed_forms import (
    BILATERAL,
    NOISE_FACTORS,
    DepthLikelihood,
    WienerFilter,
    depth_filters,
    mean_depth,
    restorations,
    restored_by_depth,
)
from kornia_tidy.psf import PSFBank
from kornia_tidy.reconstruction.wiener import wiener
from tests.base import BaseTester


def gaussians(sigmas, window=15):
    """Return a bank of one PSF for each width, three channels."""
    x = torch.arange(window) - window // 2
    psfs = torch.stack([torch.exp(-(x[:, None] ** 2 + x**2) / (2 * sigma**2)) for sigma in sigmas])
    psfs = (psfs / psfs.sum((1, 2), keepdim=True))[:, None].expand(-1, 3, -1, -1)
    return PSFBank(psfs.contiguous(), torch.linspace(-1, 1, len(sigmas)), torch.ones(len(sigmas), 3))


def texture(size, seed=0):
    """Return a periodic image whose power falls with the third power of the frequency, of mean 0.3 and spread 0.1."""
    noise = torch.randn(1, 1, size, size, generator=torch.Generator().manual_seed(seed))
    frequency = torch.hypot(torch.fft.fftfreq(size)[:, None], torch.fft.rfftfreq(size))
    shaped = torch.fft.irfft2(torch.fft.rfft2(noise) * (frequency + 1 / 64) ** -1.5, s=(size, size))
    return (0.3 + 0.1 * (shaped - shaped.mean()) / shaped.std()).expand(-1, 3, -1, -1)


class TestWienerFilter(BaseTester):
    def test_feature_is_the_function_of_the_library(self):
        bank, capture = gaussians([1.0, 2.0]), texture(40)
        shares = PHOTOGRAPHS.depth_weights(bank.defocus)
        once, noisier = WienerFilter(bank, 0.01, PHOTOGRAPHS, (40, 40))(capture, (1.0, 4.0))
        self.assert_close(once, wiener(capture, bank.psfs, 0.01, depth_weights=shares))
        self.assert_close(noisier, wiener(capture, bank.psfs, 0.02, depth_weights=shares))


class TestRestorations(BaseTester):
    def test_cardinality_each_base_with_each_bilateral_filter(self):
        capture = texture(32)
        images = restorations(capture, WienerFilter(gaussians([1.0, 2.0]), 0.01, PHOTOGRAPHS, (32, 32)))
        assert len(images) == (1 + len(NOISE_FACTORS)) * len(BILATERAL)
        assert {tuple(image.shape) for image in images.values()} == {(1, 3, 32, 32)}


class TestRestoredByDepth(BaseTester):
    def test_feature_each_region_is_restored_by_its_own_depth(self):
        """Left and right of a capture have different probabilities; of one depth it is the Wiener filter's result."""
        bank, capture = gaussians([0.6, 2.0]), texture(40)
        filters = depth_filters(bank, 0.01, PHOTOGRAPHS, (40, 40))
        probability = torch.zeros(2, 40, 40)
        probability[0, :, :20] = probability[1, :, 20:] = 1
        both = restored_by_depth(capture, filters, {"given": probability})["by depth (given), Wiener x 0.8"]
        for part, columns in enumerate((slice(0, 20), slice(20, 40))):
            own = wiener(capture, bank.psfs[part : part + 1], 0.01 * 0.8**0.5)
            self.assert_close(both[..., columns], own[..., columns])


class TestDepthLikelihood(BaseTester):
    def test_feature_finds_by_which_psf_a_texture_is_blurred(self):
        """Sharp is far here and the widest PSF is near: three depths, three tenths apart, come out in their order."""
        bank, size = gaussians([0.3 + 0.3 * depth for depth in range(11)]), 96
        likelihood = DepthLikelihood(bank, 0.001, PHOTOGRAPHS, (size, size))
        noise = 0.001 * torch.randn(1, 3, size, size, generator=torch.Generator().manual_seed(1))
        found = []
        for depth in (2, 5, 8):
            transfer = torch.fft.rfft2(bank.psfs[depth], s=(size, size))
            capture = torch.fft.irfft2(torch.fft.rfft2(texture(size)) * transfer, s=(size, size)).roll((-7, -7), (2, 3))
            probabilities = likelihood(capture + noise)
            assert {tuple(each.shape) for each in probabilities.values()} == {(11, size, size)}
            found.append([float(mean_depth(each)[32:64, 32:64].mean()) for each in probabilities.values()])
        for far, middle, near in zip(*found, strict=True):
            assert far + 0.05 < middle < near - 0.05
