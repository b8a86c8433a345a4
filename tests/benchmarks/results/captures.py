"""Captures of the benchmark: the light on the sensor, and noise by name."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import torch
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb
from torch import Tensor

from kornia_tidy.seeds import keyed_seed
from kornia_tidy.sensor import SensorNoise, exposed_sensor
from tests.benchmarks.results.scenes import BenchScene
from tests.benchmarks.results.systems import System

REFERENCE_F_NUMBER, READ_NOISE = 17.6, 2.4  # at which electrons are counted; electrons
FIXED = ("0.002", "0.01", "0.03")
PHYSICAL = ("57000e", "10000e", "2000e", "500e")
MIDDLE = 0.2  # of full scale, near the median of photographs in linear light


def sensor_of(noise: str, f_number: float) -> SensorNoise:
    """Return the sensor of a noise by name.

    Args:
        noise: a standard deviation in parts of full scale, such as ``"0.002"``, or electrons of a white pixel at
            f/17.6, such as ``"57000e"``; other f-numbers have the same exposure time.
        f_number: of the camera.

    Example:
        >>> sensor_of("10000e", 35.2)
        SensorNoise(read noise 0.00096 of full scale, full well 2500 electrons, clipped to [0, 1])
    """
    if noise.endswith("e"):
        return exposed_sensor(f_number, float(noise[:-1]), REFERENCE_F_NUMBER, READ_NOISE)
    return SensorNoise(float(noise))


def irradiance(system: System, scene: BenchScene) -> Tensor:
    """Return the linear light of a scene on the sensor of a system, without noise."""
    depth = scene.depth(system.optics.camera)
    with torch.no_grad():
        return system.optics(rgb_to_linear_rgb(scene.image), depth)


@dataclass(eq=False)
class Capture:
    """A noisy capture with all that a restoration may know: the camera and its noise, not the scene."""

    light: Tensor
    """(1, 3, H, W), linear light in [0, 1]."""
    system: System
    noise: Tensor
    """Standard deviation of the noise in linear light by the sensor's model: (1, 1, 1, 1), with shot noise of each
    pixel, (1, 3, H, W)."""
    restored: dict[object, Tensor] = field(default_factory=dict)
    """Images of inversions that were computed, by name and settings."""
    estimates: dict[object, dict[str, Tensor]] = field(default_factory=dict)
    """Maps that the network estimated, by the factor of the noise level that it was told and by orientations."""

    @cached_property
    def image(self) -> Tensor:
        """The capture encoded as sRGB, (1, 3, H, W)."""
        return encode(self.light)


def capture(system: System, scene: BenchScene, light: Tensor, noise: str) -> Capture:
    """Return a capture; systems with the same noise get the same random numbers."""
    sensor = sensor_of(noise, system.f_number)
    generator = torch.Generator().manual_seed(keyed_seed("results", scene.name, noise))
    with torch.no_grad():
        taken = sensor(light, generator=generator)
    noise_map = torch.full((1, 1, 1, 1), sensor.sigma) if sensor.full_well is None else sensor.std(taken)
    return Capture(taken, system, noise_map)


def sigma_of(noise: str, f_number: float) -> float:
    """Return the standard deviation of a noise at a fifth of full scale."""
    return float(sensor_of(noise, f_number).std(torch.tensor(MIDDLE)))


def encode(light: Tensor) -> Tensor:
    """Return the sRGB image of linear light, clipped to [0, 1]."""
    return linear_rgb_to_rgb(light.clamp(0, 1))
