from __future__ import annotations

import math

import torch

from kornia_tidy.lab.calibration.psf import resolve_psf
from tests.base import BaseTester

SIDE = 25


def airy_like(offsets, cutoff):
    """Return images of a squared sinc, (N, M, M), whose spectrum ends at a cutoff beyond Nyquist."""
    x = torch.arange(SIDE, dtype=torch.float64) - SIDE // 2
    line = torch.sinc((x - offsets[:, :, None]) * cutoff / 2).square()
    return line[:, 0, :, None] * line[:, 1, None, :]


def places(count):
    return torch.rand(count, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64) - 0.5


class TestResolvePSF(BaseTester):
    def test_feature_aliases_are_told_apart(self):
        """With frequencies up to 0.8 cycles a pixel, one shifted image has a large error and eight images have none."""
        offsets = places(8)
        images, truth = airy_like(offsets, 0.8), airy_like(torch.zeros(1, 2), 0.8)[0]
        noise = torch.full_like(images, 1e-10)
        inside = slice(4, -4)
        found = resolve_psf(images, offsets, noise, cutoff=1.2).psf
        error = (found - truth)[inside, inside].abs().sum() / truth.sum()
        frequency = torch.fft.fftfreq(SIDE, dtype=torch.float64)
        phase = torch.exp(2j * math.pi * (frequency[:, None] * offsets[0, 0] + frequency * offsets[0, 1]))
        moved = torch.fft.ifft2(torch.fft.fft2(images[0]) * phase).real
        naive = (moved - truth)[inside, inside].abs().sum() / truth.sum()
        assert error < 0.01
        assert naive > 5 * error

    def test_feature_its_samples_are_the_images_that_it_was_resolved_from(self):
        offsets = places(8)
        images = airy_like(offsets, 0.8)
        found = resolve_psf(images, offsets, torch.full_like(images, 1e-10), cutoff=1.2)
        image, gradient = found.images_at(offsets)
        self.assert_close(image[:, 4:-4, 4:-4], images[:, 4:-4, 4:-4], rtol=0, atol=5e-3)
        step = 1e-4
        for axis in range(2):
            ahead = found.images_at(offsets + step * torch.eye(2, dtype=torch.float64)[axis])[0]
            self.assert_close((ahead - image) / step, gradient[:, axis], rtol=0, atol=1e-3)

    def test_feature_the_variance_is_that_of_repeated_measurements(self):
        offsets, generator = places(6), torch.Generator().manual_seed(1)
        images = airy_like(offsets, 0.8)
        variance = 1e-4 * (0.2 + images / images.max())
        draws = []
        for _ in range(200):
            noise = variance.sqrt() * torch.randn(images.shape, generator=generator, dtype=torch.float64)
            draws.append(resolve_psf(images + noise, offsets, variance, cutoff=1.0))
        scatter = torch.stack([draw.psf for draw in draws]).var(0)
        predicted = torch.stack([draw.variance for draw in draws]).mean(0)
        ratio = scatter / predicted
        assert abs(float(ratio.mean()) - 1) < 0.1
        assert float(ratio.min()) > 0.6
        assert float(ratio.max()) < 1.6

    def test_feature_weights_of_each_pixel_keep_the_noise_of_a_bright_core_out_of_the_dark(self):
        """In repeated measurements the noise 4 pixels from the core is halved, and agrees with the stated variance."""
        offsets, generator = places(8), torch.Generator().manual_seed(1)
        images = airy_like(offsets, 0.8)
        variance = 1e-8 + 1e-4 * images * (images > 0.1)
        draws = {True: [], False: []}
        for _ in range(40):
            noise = variance.sqrt() * torch.randn(images.shape, generator=generator, dtype=torch.float64)
            for each_pixel, found in draws.items():
                found.append(resolve_psf(images + noise, offsets, variance, cutoff=1.0, each_pixel=each_pixel))
        steps = torch.arange(SIDE) - SIDE // 2
        ring = torch.maximum(steps.abs()[:, None], steps.abs()) == 4
        weighted, white = (torch.stack([one.psf for one in draws[kind]]).var(0)[ring].mean().sqrt() for kind in draws)
        said = torch.stack([one.variance for one in draws[True]]).mean(0)[ring].mean().sqrt()
        assert float(weighted) < 0.5 * float(white)
        assert 0.67 < float(weighted / said) < 1.5
