"""Sensor noise of a data sheet on ordinary images: shot, dark and read noise, full well and quantisation."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import kornia.augmentation as K
import torch
from torch import Tensor

from kornia_tidy.augmentation.ranges import Range, check_probability, checked_range, uniform_draws
from kornia_tidy.augmentation.rows import changed_rows, outside_graphs, row_seeds
from kornia_tidy.checks import check_choice, check_float_tensor
from kornia_tidy.kernels.pixel_ops import decode, encode
from kornia_tidy.mode import Mode, torch_mode
from kornia_tidy.optics.units import check_image, warn_once
from kornia_tidy.sensor.sensor import SensorNoise
from kornia_tidy.sensor.steps import quantize, shot_noise

COLOR_SPACES = ("srgb", "linear")


def sensor_noise(
    image: Tensor,
    full_well: float | Tensor,
    read_noise: float | Tensor = 0.0,
    dark: float | Tensor = 0.0,
    bits: int | None = 12,
    color_space: str = "srgb",
    params: Mapping[str, Tensor] | None = None,
    generator: torch.Generator | None = None,
) -> Tensor:
    r"""Record images with a sensor that is given by the quantities of its data sheet.

    .. math:: y = q\left( \frac{\min(\mathrm{Poisson}(w x + d), w) - d}{w} + \frac{\sigma}{w} n \right)

    with the image x in linear light, the full well w, the dark signal d, the read noise σ, a standard normal n, and
    the converter q, which rounds to ``bits`` and clips to [0, 1].

    Args:
        image: (B, C, H, W), 1 is the full well.
        full_well: electrons at full scale; one, or one for each image, (B,).
        read_noise: standard deviation in electrons; one, or one for each image.
        dark: mean dark signal in electrons; one, or one for each image. Its mean is subtracted, its noise stays.
        bits: of the converter, 1 to 16; None does not round.
        color_space: ``"srgb"`` is decoded to linear light, where noise is, and encoded after; ``"linear"`` is light.
        params: fields of an earlier draw, ``"shot"`` uniform and ``"read"`` normal, of the image's shape.
        generator: source of the noise. Default: the global generator.

    Returns:
        The recorded images: shape and type of ``image``, computed in float32 or better.

    Raises:
        TypeError: if the image is not a floating-point tensor.
        ValueError: if the image is not (B, C, H, W), has NaN or sRGB values above 16, or a quantity is negative.

    Convention:
        - Gradients are those of :func:`~kornia_tidy.sensor.steps.shot_noise`, zero where a value is clipped.
        - :class:`~kornia_tidy.SensorNoise` is the same sensor as a module, in linear light.

    Source: EMVA Standard 1288, 4.0, section 2 (linear camera model).

    Example:
        >>> sensor_noise(torch.full((2, 3, 8, 8), 0.5), full_well=1e4, read_noise=3.0).shape
        torch.Size([2, 3, 8, 8])
    """
    check_float_tensor("image", image, 4, "(B, C, H, W)")
    check_choice("color_space", color_space, COLOR_SPACES)
    if Mode.GRAPH not in torch_mode() and (said := check_image(image, encoded=color_space == "srgb")) is not None:
        warn_once(None, "image in sensor_noise", said)
    dtype = torch.promote_types(image.dtype, torch.float32)
    names = ("full_well", "read_noise", "dark")
    well, sigma, dark = (
        _of_rows(name, value, image, dtype) for name, value in zip(names, (full_well, read_noise, dark), strict=True)
    )
    if not bool((above := well > dark).all()):
        pair = " and ".join(f"{float(rows[~above][0]):g}" for rows in torch.broadcast_tensors(well, dark))
        raise ValueError(f"full_well must be positive and above dark, got {pair} electrons")
    if params is None:
        both = SensorNoise(1.0, full_well=1.0)
        params = both.draw(image.shape, device=image.device, generator=generator, dtype=dtype)
    light = decode(image.to(dtype), color_space)
    electrons = shot_noise(light.clamp(min=0) * well + dark, params["shot"].to(light)).minimum(well)
    value = (electrons - dark + sigma * params["read"].to(light)) / well
    value = (value if bits is None else quantize(value, bits)).clamp(0, 1)
    return encode(value, color_space).to(image.dtype)


def _of_rows(name: str, value: float | Tensor, image: Tensor, dtype: torch.dtype) -> Tensor:
    """Return a quantity as (B, 1, 1, 1) or (1, 1, 1, 1)."""
    rows = torch.as_tensor(value, device=image.device, dtype=dtype).reshape(-1, 1, 1, 1)
    if len(rows) not in (1, len(image)):
        raise ValueError(f"{name} must be one number or one for each of {len(image)} images, got {len(rows)}")
    allowed = (rows >= 0) & rows.isfinite()
    if not bool(allowed.all()):
        raise ValueError(f"{name} must be zero or positive electrons, and finite, got {float(rows[~allowed][0])}")
    return rows


class RandomSensorNoise(K.IntensityAugmentationBase2D):
    """Record images with a sensor whose full well, read noise and dark signal are drawn for each image.

    Args:
        full_well: range in electrons: the fewer, the more shot noise.
        read_noise: range of its standard deviation in electrons.
        dark: range of the mean dark signal in electrons.
        bits: of the converter, 1 to 16; None does not round.
        color_space: ``"srgb"`` or ``"linear"``, see :func:`sensor_noise`.
        same_on_batch: one draw for the whole batch, noise included.
        p: probability of each image to be recorded. Images that are not are not computed.
        keepdim: return (C, H, W) for (C, H, W).

    Shape:
        - (B, C, H, W) or (C, H, W) in [0, 1], to the same, (1, C, H, W) for (C, H, W) without ``keepdim``.

    Raises:
        TypeError: if a range is not two numbers.
        ValueError: if a range is empty or negative, the dark signal reaches the full well, or ``p`` is not from 0 to 1.

    Convention:
        - Values are uniform in their ranges. ``_params`` holds them and a seed for each image, from which its noise
          follows: the same ``params=`` give the same bits, whatever the batch and the device.
        - The image is clipped to [0, 1].
        - Compiled graphs call it eagerly.

    Source: EMVA Standard 1288, 4.0, section 2 (linear camera model).

    Example:
        >>> augmentation = RandomSensorNoise(full_well=(500.0, 5000.0), read_noise=(1.0, 10.0), p=1.0)
        >>> image = torch.rand(2, 3, 16, 16)
        >>> torch.equal(augmentation(image), augmentation(image, params=augmentation._params))
        True
    """

    def __init__(
        self,
        full_well: Range = (1e3, 2e4),
        read_noise: Range = (1.0, 10.0),
        dark: Range = (0.0, 0.0),
        bits: int | None = 12,
        color_space: str = "srgb",
        same_on_batch: bool = False,
        p: float = 0.5,
        keepdim: bool = False,
    ) -> None:
        check_probability(p)
        super().__init__(same_on_batch=same_on_batch, p=p, keepdim=keepdim)
        check_choice("color_space", color_space, COLOR_SPACES)
        wells = checked_range("full_well", full_well, "electrons")
        darks = checked_range("dark", dark, "electrons", zero=True)
        if darks[1] >= wells[0]:
            raise ValueError(f"dark must stay below full_well, got up to {darks[1]:g} of {wells[0]:g} electrons")
        SensorNoise(bits=bits)  # checks the bits
        reads = checked_range("read_noise", read_noise, "electrons", zero=True)
        self._param_generator = uniform_draws({"full_well": wells, "read_noise": reads, "dark": darks})
        self.flags = {"bits": bits, "color_space": color_space}

    def generate_parameters(self, batch_shape: tuple[int, ...]) -> dict[str, Tensor]:
        """Return the draws of a batch: a value of each range and a seed for each image, (B,)."""
        seeds = row_seeds(batch_shape[0], self.same_on_batch)
        return {**super().generate_parameters(batch_shape), "seed": seeds}

    @outside_graphs  # which rows are computed depends on values
    def apply_transform(
        self, input: Tensor, params: dict[str, Tensor], flags: dict[str, Any], transform: Tensor | None = None
    ) -> Tensor:
        """Return the images, those recorded that the draw names."""

        def change(rows: Tensor | slice, drawn: dict[str, Tensor]) -> Tensor:
            seen = input[rows]
            parts = []
            for row, seed in enumerate(drawn["seed"].tolist()):
                own: dict[str, Any] = {name: drawn[name][row] for name in ("full_well", "read_noise", "dark")}
                source = torch.Generator().manual_seed(int(seed))
                parts.append(sensor_noise(seen[row : row + 1], **own, **self.flags, generator=source))
            return torch.cat(parts)

        return changed_rows(input, params, self.p == 1 and self.p_batch == 1, change)
