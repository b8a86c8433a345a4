from __future__ import annotations

import pytest
import torch

from kornia_tidy.lab.calibration.psf import register
from kornia_tidy.lab.calibration.psf.point_images import MARGIN, PointImage
from tests.base import BaseTester

SIDE = 15 + 2 * MARGIN
NOISE = 1e-3


def shot(row, column, brightness, generator):
    """Return the image of a round spot with an error of up to a fifth of a pixel in its stated position."""
    x = torch.arange(float(SIDE), dtype=torch.float64) - SIDE // 2
    light = brightness * torch.exp(-((x[:, None] - row) ** 2 + (x - column) ** 2) / 6)[None]
    light = light + NOISE * torch.randn(light.shape, generator=generator, dtype=torch.float64)
    wrong = 0.4 * torch.rand(2, generator=generator, dtype=torch.float64) - 0.2
    place = 50 + row + float(wrong[0]), 60 + column + float(wrong[1])
    return PointImage(place, light, torch.full_like(light, NOISE**2))


@pytest.fixture(scope="module")
def shots():
    generator = torch.Generator().manual_seed(0)
    truth = torch.rand(10, 3, generator=generator, dtype=torch.float64) * torch.tensor([0.5, 0.5, 0.4])
    truth = truth - torch.tensor([0.25, 0.25, -0.8])
    return truth, [shot(*row, generator) for row in truth.tolist()]


class TestRegister(BaseTester):
    def test_feature_places_and_brightness_are_found(self, shots):
        truth, images = shots
        found = register(images, [0.6])
        told = torch.tensor([image.offset for image in images], dtype=torch.float64)
        assert bool(found.used.all())
        wanted = truth[:, :2] - truth[:, :2].mean(0)
        self.assert_close(found.offsets - found.offsets.mean(0), wanted, rtol=0, atol=5e-3)
        assert float((told - told.mean(0) - wanted).abs().max()) > 0.1
        self.assert_close(found.brightness, truth[:, 2] / truth[:, 2].mean(), rtol=5e-3, atol=0)
        self.assert_close(found.offsets.mean(0), told.mean(0), rtol=0, atol=1e-9)

    def test_feature_residuals_are_the_noise(self, shots):
        assert float(register(shots[1], [0.6]).misfit.mean()) == pytest.approx(1.0, abs=0.15)

    def test_feature_the_image_that_differs_is_left_out(self, shots):
        odd = shots[1][4]
        light = odd.light.clone()
        light[:, 18:21, 10:13] += 0.1
        images = [*shots[1][:4], PointImage(odd.place, light, odd.variance), *shots[1][5:]]
        found = register(images, [0.6])
        assert (~found.used).nonzero().flatten().tolist() == [4]
        assert float(found.misfit[4]) > 10 * float(found.misfit[found.used].mean())

    def test_feature_a_single_image_is_its_own_psf(self, shots):
        found = register(shots[1][:1], [0.6])
        assert found.brightness.tolist() == pytest.approx([1.0], abs=1e-3)
        assert bool(found.used.all())
