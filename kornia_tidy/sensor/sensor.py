"""The sensor as a camera sees it: noise is drawn in strips of rows, and light recorded with it, in its place.

:class:`SensorNoise` has shot, dark and read noise, full well, and quantisation by the analogue-to-digital converter.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor, nn

from kornia_tidy.checks import (
    check_choice,
    check_count,
    check_float_tensor,
    check_generator,
    check_not_negative,
    check_part,
    check_positive,
)
from kornia_tidy.kernels.pixel_ops import record
from kornia_tidy.kernels.precision import safe_sqrt
from kornia_tidy.mode import Mode, torch_mode
from kornia_tidy.optics.units import NONSENSE_CODE, check_image, warn_once
from kornia_tidy.sensor.fixed_pattern import check_pattern, pattern_at
from kornia_tidy.sensor.steps import MOST_BITS

STRIP = 64  # rows of noise drawn in one call
MOST_ELECTRONS = 1e30  # of a full well, and the least is its inverse: beyond, float32 has no ratios of electrons


class Sensor(nn.Module):
    """Base of sensors: a subclass draws noise and records light with it.

    A camera takes any module with this ``forward`` and ``draw``. CONTRIBUTING has a recipe. Restorations that use the
    noise call a method ``std(light)``: the standard deviation of what is drawn in units of full scale.

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
            ValueError: if the image is not (B, C, H, W), a value is NaN or infinite, a field is missing or has another
                shape, or both ``params`` and ``generator`` are given.
        """
        check_float_tensor("image", image, 4, "(B, C, H, W)")
        if not torch_mode() & (Mode.GRAPH | Mode.UNREAD):
            mean = float(image.detach().mean()) if image.numel() else 0.0  # one pass, NaN if any value is
            if not 0 <= mean <= NONSENSE_CODE:
                _check_light(image, mean, getattr(self, "clip", False))
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


def _check_light(image: Tensor, mean: float, clip: bool) -> None:
    """Raise an error for values that are no light, and warn once of a picture that the full well turns white."""
    said = check_image(image, encoded=False)
    if said is None and clip and mean > NONSENSE_CODE:
        said = (
            f"image holds {mean:.3g} times full scale on average and is recorded as white: divide 8-bit values by 255 "
            f"and 16-bit ones by 65535"
        )
    if said is not None:
        warn_once(None, "image on a sensor", said, stacklevel=5)


def _field(params: Mapping[str, Tensor], name: str, light: Tensor) -> Tensor:
    if name not in params:
        raise ValueError(f"params must hold the field {name!r} as draw() returns it, got {sorted(params)}")
    if params[name].shape != light.shape:
        raise ValueError(
            f"params[{name!r}] must have the image's shape {tuple(light.shape)}, got {tuple(params[name].shape)}"
        )
    return params[name].to(light)


class SensorNoise(Sensor):
    r"""A sensor: converts a linear-light image to the recorded image, also in linear light.

    The steps, with full scale = 1.0 = ``full_well`` electrons:

    1. shot noise: N = Poisson(full_well · max(image · response, 0) + dark), one draw for signal and dark signal;
    2. full well: N is limited to ``full_well``;
    3. black level: (N - dark) / full_well;
    4. read noise: a Gaussian of standard deviation ``sigma``, and ``offset``, are added;
    5. converter: the value is rounded to ``bits``, see :func:`quantize`;
    6. the value is clipped to [0, 1].

    Steps 1 to 3 need ``full_well``, step 5 needs ``bits``. The noise is drawn in training and in ``eval()`` alike, as
    a real camera also has it at test time.

    Args:
        sigma: standard deviation of the read noise, in units of full scale.
        full_well: capacity of a pixel in electrons; enables shot noise. None: no shot noise.
        dark: mean dark signal over the exposure, in electrons, below ``full_well``. Its shot noise stays in the image.
            Its mean is subtracted as black level, so a saturated pixel has the value 1 - dark / full_well.
        bits: bits of the converter, 1 to 16. None: no rounding.
        clip: limit to the full well and to [0, 1]. False keeps highlights above 1 (HDR) and negative noise.
        response: of each pixel to light, 1 on average (PRNU): (H, W) or (C, H, W) of the whole sensor, with 1 in the
            place of H or W where rows or columns are alike. None: all pixels respond alike.
        offset: of each pixel in units of full scale (DSNU, columns), as ``response``. See :func:`draw_pattern`.

    Raises:
        ValueError: if a value is out of its range, or ``dark`` is given without ``full_well``.

    Shape:
        - image: (B, C, H, W), linear light, 1.0 = full scale, float16, bfloat16, float32 or float64.
        - Output: the same shape and dtype, also under autocast computed in float32 (float64 for float64).

    Convention:
        - Gradients are those of :func:`shot_noise` and :func:`quantize`, and zero where a value is clipped.
        - Clipping lowers the variance: white on a full well keeps a third of it. As shot noise from 25 electrons on is
          Gaussian, without the skewness of Poisson's, what is left of a clipped white is 7 % more than Poisson's for a
          full well of 30 electrons, 4 % for 100, 1 % for 1,000. :meth:`std` is that without clipping.

    Source: EMVA Standard 1288, 4.0, section 2 (linear camera model); photon transfer, Janesick 2007.

    Example:
        >>> sensor = SensorNoise.physical(full_well=10500, read_noise_electrons=2.4)
        >>> sensor(torch.full((1, 3, 4, 4), 0.5)).shape
        torch.Size([1, 3, 4, 4])
        >>> SensorNoise().sigma
        0.01
        >>> SensorNoise(0.0)(torch.tensor([-0.5, 0.5, 1.5]).view(1, 1, 1, 3)).flatten()
        tensor([0.0000, 0.5000, 1.0000])
    """

    response: Tensor | None
    offset: Tensor | None

    def __init__(
        self,
        sigma: float = 0.01,
        *,
        full_well: float | None = None,
        dark: float = 0.0,
        bits: int | None = None,
        clip: bool = True,
        response: Tensor | None = None,
        offset: Tensor | None = None,
    ) -> None:
        super().__init__()
        check_not_negative("sigma", sigma, "in units of full scale")
        if sigma > 1:
            said = f"sigma is {sigma:g} times full scale: divide 8-bit levels by 255, electrons by the full well"
            warn_once(None, "sigma of a sensor", said)
        check_not_negative("dark", dark, "electrons")
        if full_well is not None:
            check_positive("full_well", full_well, "electrons")
            if not 1 / MOST_ELECTRONS <= full_well <= MOST_ELECTRONS:
                allowed = f"between {1 / MOST_ELECTRONS:g} and {MOST_ELECTRONS:g}"
                raise ValueError(f"full_well must be electrons {allowed}, got {full_well}")
            if dark >= full_well:
                raise ValueError(f"dark must be below full_well, {full_well} electrons, got {dark}")
        elif dark:
            raise ValueError(
                f"dark needs full_well, the number of electrons at full scale, got dark = {dark} without it"
            )
        if bits is not None:
            check_count("bits", bits, most=MOST_BITS)
        self.sigma, self.full_well, self.dark, self.bits, self.clip = sigma, full_well, dark, bits, clip
        for name, plane in (("response", response), ("offset", offset)):
            check_pattern(name, plane)
            self.register_buffer(name, plane)

    @classmethod
    def physical(
        cls, full_well: float, read_noise_electrons: float, dark_electrons: float = 0.0, bits: int = 12
    ) -> SensorNoise:
        """Return a sensor from the quantities of a data sheet, in electrons.

        Args:
            full_well: capacity of a pixel.
            read_noise_electrons: standard deviation of the read noise.
            dark_electrons: mean dark signal over the exposure.
            bits: bits of the converter; its levels span the full well.

        Raises:
            ValueError: if a value is out of its range.

        Example:
            >>> SensorNoise.physical(full_well=10000, read_noise_electrons=5)
            SensorNoise(read noise 0.0005 of full scale, full well 10000 electrons, 12 bits, clipped to [0, 1])
        """
        check_positive("full_well", full_well, "electrons")
        check_not_negative("read_noise_electrons", read_noise_electrons, "electrons")
        return cls(read_noise_electrons / full_well, full_well=full_well, dark=dark_electrons, bits=bits)

    @property
    def noise(self) -> dict[str, Callable[..., Tensor]]:
        """The draws: "read" if ``sigma`` is not zero, "shot", uniform in [0, 1), if ``full_well`` is given."""
        samplers: dict[str, Callable[..., Tensor]] = {"read": torch.randn} if self.sigma > 0 else {}
        return samplers if self.full_well is None else samplers | {"shot": torch.rand}

    def record(self, light: Tensor, noise: Mapping[str, Tensor], origin: tuple[int, int]) -> Tensor:
        """Return the noisy light. See the class.

        Raises:
            ValueError: if the light reaches beyond the pixels of ``response`` or ``offset``.
        """
        if self.response is not None:
            light = light * pattern_at("response", self.response, light, origin)
        return record(
            light,
            noise.get("shot"),
            noise.get("read"),
            None if self.offset is None else pattern_at("offset", self.offset, light, origin).expand_as(light),
            1.0 if self.full_well is None else self.full_well,
            self.dark,
            self.sigma,
            self.bits,
            self.clip,
        )

    def std(self, image: Tensor) -> Tensor:
        r"""Return the standard deviation of the noise in each pixel, before the clip; a fixed pattern does not count.

        .. math:: \sqrt{\sigma^2 + (x + d / w) / w + q^2 / 12}

        Here x is the image, d the dark signal, w the full well and q the step of the converter.

        Args:
            image: linear light without noise, or the capture itself as an estimate of it, any shape. Negative values
                give no electrons.

        Returns:
            Standard deviation in units of full scale, same shape and dtype.

        Source: EMVA Standard 1288, 4.0, section 2.3.

        Example:
            >>> SensorNoise(0.003, full_well=10000.0).std(torch.tensor([0.0, 0.16]))
            tensor([0.0030, 0.0050])
        """
        variance = torch.full_like(image, self.sigma**2)
        if self.full_well is not None:
            variance = variance + (image.clamp(min=0) + self.dark / self.full_well) / self.full_well
        if self.bits is not None:
            variance = variance + (2**self.bits - 1) ** -2.0 / 12
        return safe_sqrt(variance)

    def extra_repr(self) -> str:
        """Return a one-line description of the sensor."""
        pattern = [name for name in ("response", "offset") if getattr(self, name) is not None]
        words = [f"read noise {self.sigma:g} of full scale" if self.sigma > 0 else "no read noise"]
        words += ["no shot noise" if self.full_well is None else f"full well {self.full_well:g} electrons"]
        words += [f"dark signal {self.dark:g} electrons"] if self.dark else []
        words += [] if self.bits is None else [f"{self.bits} bits"]
        words += [f"pixels with {' and '.join(pattern)} of their own"] if pattern else []
        words += ["clipped to [0, 1]" if self.clip else "not clipped"]
        return ", ".join(words)


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
