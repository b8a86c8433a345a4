"""Sensor noise: shot, dark and read noise, full well, and quantisation by the analogue-to-digital converter."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from kornia_tidy.checks import check_number, check_positive
from kornia_tidy.kernels.sensor_ops import record
from kornia_tidy.sensor.fixed_pattern import check_pattern, pattern_at
from kornia_tidy.sensor.sensor import Sensor
from kornia_tidy.sensor.steps import check_bits


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

    Source: EMVA Standard 1288, 4.0, section 2 (linear camera model); photon transfer, Janesick 2007.

    Example:
        >>> sensor = SensorNoise.physical(full_well=10500, read_noise_electrons=2.4)
        >>> sensor(torch.full((1, 3, 4, 4), 0.5)).shape
        torch.Size([1, 3, 4, 4])
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
        _check_not_negative("sigma", sigma, "in units of full scale")
        _check_not_negative("dark", dark, "electrons")
        if full_well is not None:
            check_positive("full_well", full_well, "electrons")
            if dark >= full_well:
                raise ValueError(f"dark must be below full_well, {full_well} electrons, got {dark}")
        elif dark:
            raise ValueError(f"dark needs full_well, the number of electrons at full scale, got dark = {dark} alone")
        if bits is not None:
            check_bits(bits)
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
        _check_not_negative("read_noise_electrons", read_noise_electrons, "electrons")
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
        return variance.sqrt()

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


def _check_not_negative(name: str, value: float, unit: str) -> None:
    check_number(name, value, unit)
    if not 0 <= value < float("inf"):
        raise ValueError(f"{name} must be zero or positive and finite, {unit}, got {value}")
