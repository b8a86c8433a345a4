"""Exposure at an f-number, and the standard deviation of a sensor's noise."""

from __future__ import annotations

import pytest
import torch

from kornia_tidy.sensor import SensorNoise, electrons_at, exposed_sensor


def test_smoke():
    assert exposed_sensor(17.6, electrons=1000, reference_f_number=17.6).full_well == 1000


@pytest.mark.parametrize("values", [(0, 1, 1), (1, -1, 1), (1, 1, float("nan"))])
def test_exception(values):
    with pytest.raises(ValueError, match="positive"):
        electrons_at(*values)


def test_feature_light_falls_with_the_square_of_the_f_number():
    assert electrons_at(44.0, 5000, 22.0) == 1250
    assert exposed_sensor(44.0, 5000, 22.0).sigma == 2.4 / 1250


@pytest.mark.parametrize(
    "sensor",
    [
        SensorNoise(0.01, clip=False),
        SensorNoise(0.002, full_well=900.0, clip=False),
        SensorNoise(0.0, full_well=400.0, dark=30.0, clip=False),
        SensorNoise(0.003, bits=6, clip=False),
        SensorNoise(0.004, full_well=5000.0, dark=2.0, bits=8, clip=False),
    ],
    ids=repr,
)
def test_feature_std_is_that_of_drawn_noise(sensor):
    # The quantisation error is uniform where the noise spans a step or the values do: a ramp of values.
    image = torch.linspace(0.2, 0.8, 200_000).view(1, 1, 400, 500)
    noise = sensor(image, generator=torch.Generator().manual_seed(0)) - image
    measured = (noise / sensor.std(image)).square().mean()
    # The mean of n squares of normal values has the standard deviation sqrt(2 / n); five of them.
    assert abs(measured - 1) < 5 * (2 / image.numel()) ** 0.5


def test_feature_std_of_negative_light_is_that_of_darkness():
    sensor = SensorNoise(0.01, full_well=100.0)
    assert torch.equal(sensor.std(torch.tensor([-1.0])), sensor.std(torch.tensor([0.0])))
    dark = torch.zeros(1, requires_grad=True)
    assert torch.autograd.grad(SensorNoise(0.0, full_well=100.0).std(dark), dark)[0] == 0
