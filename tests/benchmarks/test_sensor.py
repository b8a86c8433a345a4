"""How long the sensor takes: read noise alone, and everything it has."""

from __future__ import annotations

import pytest
import torch

from kornia_tidy.sensor import SensorNoise, quantize, shot_noise

SENSORS = {
    "read": SensorNoise(0.01),
    "shot": SensorNoise(0.01, full_well=10_000.0),
    "physical": SensorNoise.physical(full_well=10_000, read_noise_electrons=3.0, bits=12),
}


@pytest.fixture
def image(size, device):
    return torch.rand(1, 3, size, size, device=device, requires_grad=True)


class TestSensor:
    @pytest.mark.parametrize("kind", SENSORS)
    def test_noise(self, bench, image, kind):
        bench(lambda: SENSORS[kind](image.detach()))

    @pytest.mark.parametrize("kind", SENSORS)
    def test_noise_and_gradients(self, bench, image, kind):
        bench(lambda: torch.autograd.grad(SENSORS[kind](image).mean(), image))

    @pytest.mark.parametrize("electrons", [5.0, 500.0])
    def test_shot_noise(self, bench, image, electrons):
        uniform = torch.rand_like(image)
        bench(lambda: shot_noise(electrons * image.detach(), uniform))

    def test_quantize(self, bench, image):
        bench(lambda: quantize(image.detach(), 12))
