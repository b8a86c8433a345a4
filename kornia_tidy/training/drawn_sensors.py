"""A separate sensor for each capture of a batch, so that masks learn for a range of noise."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager
from typing import cast

import torch
from torch import Tensor, nn

from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.sensor.sensor import Sensor, SensorNoise


class SensorEach(Sensor):
    """A batch of sensors, one for each capture.

    Args:
        sensors: as many as the batch has captures.

    Raises:
        ValueError: if a batch has another number of captures.

    Shape:
        - irradiance: (B, C, H, W), linear light, full scale 1. Output: the same.

    Example:
        >>> sensors = SensorEach([SensorNoise(0.0), SensorNoise(0.1)])
        >>> seen = sensors(torch.full((2, 1, 8, 8), 0.5))
        >>> [round(float(one.std()), 1) for one in seen]
        [0.0, 0.1]
    """

    def __init__(self, sensors: Sequence[SensorNoise]) -> None:
        super().__init__()
        self.sensors = nn.ModuleList(sensors)

    @property
    def noise(self) -> dict[str, Callable[..., Tensor]]:
        """What any of the sensors draws."""
        return {name: draw for sensor in self.sensors for name, draw in cast("Sensor", sensor).noise.items()}

    def record(self, light: Tensor, noise: Mapping[str, Tensor], origin: tuple[int, int]) -> Tensor:
        """Return the recorded captures."""
        seen = []
        for n, (sensor, one) in enumerate(self._each(light)):
            own = {name: noise[name][n : n + 1] for name in sensor.noise}
            seen.append(sensor.record(one[None], own, origin))
        return torch.cat(seen)

    def std(self, image: Tensor) -> Tensor:
        """Return the standard deviation of the noise in each pixel of a batch, see :meth:`SensorNoise.std`."""
        return torch.cat([sensor.std(one[None]) for sensor, one in self._each(image)])

    def _each(self, batch: Tensor) -> list[tuple[SensorNoise, Tensor]]:
        if len(batch) != len(self.sensors):
            raise ValueError(f"{len(self.sensors)} sensors take as many captures, got {len(batch)}")
        return list(zip(self.sensors, batch, strict=True))  # ty: ignore[invalid-explicit-return]


@contextmanager
def with_sensor(optics: TiDyOptics, sensor: nn.Module | None) -> Generator[None]:
    """Let a camera have another sensor for a block.

    Example:
        >>> optics = TiDyOptics()
        >>> with with_sensor(optics, None):
        ...     print(optics.sensor)
        None
        >>> optics.sensor.sigma
        0.01
    """
    own = optics.sensor
    optics.sensor = sensor
    try:
        yield
    finally:
        optics.sensor = own
