"""The sensor as a camera sees it: what any module must take and return to stand in the place of ``SensorNoise``."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence
from typing import Protocol

import torch
from torch import Tensor, nn

from kornia_tidy.checks import check_part


class Sensor(Protocol):
    """What a camera asks of its sensor, an ``nn.Module``. CONTRIBUTING has a recipe.

    A method ``std(light)``, the standard deviation of the noise in units of full scale, is asked for by what restores
    captures by the noise they have.
    """

    def forward(
        self,
        irradiance: Tensor,
        params: Mapping[str, Tensor] | None = None,
        generator: torch.Generator | None = None,
        origin: tuple[int, int] = (0, 0),
    ) -> Tensor:
        """Return what is recorded of an irradiance, in linear light.

        Args:
            irradiance: (B, C, h, w), 1.0 = full scale.
            params: random fields of an earlier :meth:`draw`, for this part of the capture.
            generator: source of random numbers.
            origin: row and column of the sensor at the first pixel: a large picture comes some rows at a time.
        """
        ...

    def draw(
        self,
        shape: Sequence[int],
        device: torch.device | str | None = None,
        generator: torch.Generator | None = None,
        dtype: torch.dtype = torch.float32,
    ) -> dict[str, Tensor]:
        """Draw the random fields of one capture, (B, C, h, w)."""
        ...


def check_sensor(sensor: nn.Module | None) -> None:
    """Raise an error unless this is a sensor, or None.

    Args:
        sensor: of a camera.

    Raises:
        TypeError: if it is no module, or does not take the place of its image on the sensor.

    Example:
        >>> check_sensor(nn.Identity())
        Traceback (most recent call last):
        TypeError: sensor must take origin=(row, column), the place of an image's first pixel on it, got \
Identity.forward(input): see kornia_tidy.sensor.Sensor
    """
    if sensor is None:
        return
    check_part("sensor", sensor, nn.Module, "a sensor such as SensorNoise(0.01), or None for no noise")
    taken = inspect.signature(sensor.forward).parameters
    if "origin" not in taken and not any(p.kind is inspect.Parameter.VAR_KEYWORD for p in taken.values()):
        raise TypeError(
            f"sensor must take origin=(row, column), the place of an image's first pixel on it, got "
            f"{type(sensor).__name__}.forward({', '.join(taken)}): see kornia_tidy.sensor.Sensor"
        )
