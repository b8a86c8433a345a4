"""The sensor as a camera sees it: noise is drawn in strips of rows, and light recorded with it, in its place."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor, nn

from kornia_tidy.checks import check_choice, check_float_tensor, check_generator, check_part

STRIP = 64  # rows of noise drawn in one call


class Sensor(nn.Module):
    """Base of sensors: a subclass draws noise and records light with it.

    A camera takes any module with this ``forward`` and ``draw``. CONTRIBUTING has a recipe. Restorations that use the
    noise call a method ``std(light)``: the standard deviation of the noise in units of full scale.

    Shape:
        - image: (B, C, H, W), linear light, 1.0 = full scale, float16, bfloat16, float32 or float64.
        - Output: the same shape and dtype, also under autocast computed in float32 (float64 for float64).

    Example:
        >>> class Film(Sensor):
        ...     noise = {"grain": torch.randn}
        ...     def record(self, light, noise, origin):
        ...         return light * (1 + 0.1 * noise["grain"])
        >>> film, light = Film(), torch.ones(1, 1, 4, 4)
        >>> drawn = film.draw(light.shape)
        >>> torch.equal(film(light, params=drawn), 1 + 0.1 * drawn["grain"])
        True
    """

    @property
    def noise(self) -> Mapping[str, Callable[..., Tensor]]:
        """The draws for each value of an image: names, and functions such as ``torch.randn``."""
        return {}

    def record(self, light: Tensor, noise: Mapping[str, Tensor], origin: tuple[int, int]) -> Tensor:
        """Return the record in linear light.

        Args:
            light: (B, C, h, w) float32 or float64, 1.0 = full scale.
            noise: what :attr:`noise` names, of the light's shape and dtype.
            origin: row and column of the sensor at the first pixel: a large picture comes some rows at a time.
        """
        raise NotImplementedError

    def forward(
        self,
        image: Tensor,
        params: Mapping[str, Tensor] | None = None,
        generator: torch.Generator | None = None,
        origin: tuple[int, int] = (0, 0),
    ) -> Tensor:
        """Return the noisy image.

        Args:
            image: (B, C, H, W), linear light, 1.0 = full scale.
            params: random fields of an earlier :meth:`draw`, to be used again; needed for reproducible noise under
                ``torch.compile``.
            generator: source of random numbers, in eager mode only; it may be on another device than the image.
                Default: the global generator of the image's device.
            origin: row and column of the sensor at the image's first pixel, which places fixed patterns. The
                noise does not depend on it.

        Raises:
            TypeError: if the image is not a floating-point tensor.
            ValueError: if the image is not (B, C, H, W), a field is missing or has another shape, or both ``params``
                and ``generator`` are given.
        """
        check_float_tensor("image", image, 4, "(B, C, H, W)")
        light = image.to(torch.promote_types(image.dtype, torch.float32))
        if params is None:
            fields = self.draw(image.shape, image.device, generator, light.dtype)
        elif generator is not None:
            raise ValueError("give params to replay or generator to draw, got both")
        else:
            fields = {name: _field(params, name, light) for name in self.noise}
        return self.record(light, fields, origin).to(image.dtype)

    def draw(
        self,
        shape: Sequence[int],
        device: torch.device | str | None = None,
        generator: torch.Generator | None = None,
        dtype: torch.dtype = torch.float32,
    ) -> dict[str, Tensor]:
        """Draw the random fields for an image of this shape: those that :attr:`noise` names.

        Args:
            shape: the image's shape (B, C, H, W).
            device: device of the fields. They are drawn on the generator's device, so a CPU generator gives the same
                fields for every device.
            generator: source of random numbers. Default: the global generator of ``device``.
            dtype: float32 or float64.

        Raises:
            ValueError: if ``dtype`` is neither.

        Convention:
            - Fields are drawn in strips of 64 rows from the top, so that an image rendered in bands has the same noise
              as the whole.
        """
        if dtype != torch.float32:
            check_choice("dtype", dtype, (torch.float32, torch.float64))
        if generator is not None:
            check_generator(generator)
        source = device if generator is None else generator.device
        *outer, height, width = shape
        fields: dict[str, Tensor] = {}
        for top in range(0, max(height, 1), STRIP):
            part = (*outer, min(STRIP, height - top), width)
            for name, sampler in self.noise.items():
                drawn = sampler(part, generator=generator, device=source, dtype=dtype)
                if name not in fields:
                    fields[name] = drawn.new_empty(*shape, device=device)
                fields[name][..., top : top + STRIP, :] = drawn.to(device)
        return fields


def _field(params: Mapping[str, Tensor], name: str, light: Tensor) -> Tensor:
    if name not in params:
        raise ValueError(f"params must hold the field {name!r} as draw() returns it, got {sorted(params)}")
    if params[name].shape != light.shape:
        raise ValueError(
            f"params[{name!r}] must have the image's shape {tuple(light.shape)}, got {tuple(params[name].shape)}"
        )
    return params[name].to(light)


def check_sensor(sensor: nn.Module | None) -> None:
    """Raise an error unless this is a sensor, or None.

    Args:
        sensor: of a camera.

    Raises:
        TypeError: if it is not a module, or does not take the place of its image on the sensor.

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
