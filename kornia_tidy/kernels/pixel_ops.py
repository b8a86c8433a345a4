r"""Pixel values: sRGB decoded to linear light and back, and what a sensor records. In C for processors, else in torch.

Each number of the result follows from the numbers at the same place of some tensors.

.. math::
    L(x) = \begin{cases} x / 12.92 & x \le 0.04045 \\ ((x + 0.055) / 1.055)^{2.4} & \text{else} \end{cases}
    \qquad
    x(L) = \begin{cases} 12.92 \, L & L \le 0.0031308 \\ 1.055 \, L^{1 / 2.4} - 0.055 & \text{else} \end{cases}

Values above 1 follow the power law, negative ones the line. Up to 1 the operators are at most 2e-7 off in float32.

.. math::
    N = \mathrm{Poisson}(w \max(x, 0) + d), \qquad
    y = \mathrm{clip}_0^1 \, q\!\left( \frac{\min(N, w) - d}{w} + \sigma n + o \right)

with the light x, full well w, dark signal d, read noise :math:`\sigma n`, offset o and the converter q. The random
numbers are given, so that the same ones give the same values. With and without the operator these are equal to the last
bit, but where more than 25 electrons are drawn they differ by rounding, and one in 1e5 by a level of the converter.

Source: IEC 61966-2-1.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb
from torch import Tensor

from kornia_tidy.kernels.build import KERNELS, REALS, compiled, load
from kornia_tidy.kernels.operators import call, differentiable_gradients, operator
from kornia_tidy.kernels.shot_noise import drawn_electrons
from kornia_tidy.mode import Mode, torch_mode

SOURCE = KERNELS / "pixels.c"


def decode(image: Tensor, color_space: str = "srgb") -> Tensor:
    """Return linear light from an image, of sRGB by the operator ``kornia_tidy::srgb`` where it is compiled.

    Args:
        image: floating point, of any shape and on any device.
        color_space: ``"srgb"``; in any other the image is the light.

    Returns:
        Of the same shape, dtype and device. It has gradients, which can be differentiated in turn.

    Example:
        >>> decode(torch.tensor([-1.292, 0.0, 0.5, 1.0, 2.0])).round(decimals=4)
        tensor([-0.1000,  0.0000,  0.2140,  1.0000,  4.9538])
    """
    return _convert(image, encode=False) if color_space == "srgb" else image


def encode(light: Tensor, color_space: str = "srgb") -> Tensor:
    """Return an image from linear light, in sRGB by the operator ``kornia_tidy::srgb`` where it is compiled.

    Args:
        light: floating point, of any shape and on any device.
        color_space: ``"srgb"``; in any other the light is the image.

    Returns:
        Of the same shape, dtype and device. It has gradients, which can be differentiated in turn.

    Example:
        >>> encode(torch.tensor([-0.1, 0.0, 0.2140411, 1.0])).round(decimals=4)
        tensor([-1.2920,  0.0000,  0.5000,  1.0000])
    """
    return _convert(light, encode=True) if color_space == "srgb" else light


def _goes_in_c(x: Tensor) -> bool:
    traced = torch_mode() & Mode.TRACED  # a compiler fuses torch's own
    return x.device.type == "cpu" and x.dtype in REALS and not traced and compiled(SOURCE, x.dtype) is not None


def _convert(image: Tensor, encode: bool) -> Tensor:
    return _srgb(image, encode) if _goes_in_c(image) else _convert_by_torch(image, encode)


def _convert_by_torch(image: Tensor, encode: bool) -> Tensor:
    """Convert by kornia's functions, which want three channels and treat them alike."""
    function = linear_rgb_to_rgb if encode else rgb_to_linear_rgb
    if image.ndim > 2 and image.shape[-3] == 3:
        return function(image)
    return function(image.reshape(1, -1, 1).expand(3, -1, -1))[0].reshape(image.shape)


def record(
    light: Tensor,
    shot: Tensor | None = None,
    read: Tensor | None = None,
    offset: Tensor | None = None,
    full_well: float = 1.0,
    dark: float = 0.0,
    sigma: float = 1.0,
    bits: int | None = None,
    clip: bool = False,
) -> Tensor:
    """Return the values that a sensor reports of light. See the module for the formula.

    Args:
        light: float32 or float64, any shape, 1.0 = full scale.
        shot: uniform random numbers for shot noise, of the light's shape and dtype. None: no shot noise.
        read: standard normal random numbers for read noise, or None.
        offset: of each pixel in units of full scale, or None.
        full_well: electrons at full scale.
        dark: mean dark signal in electrons.
        sigma: standard deviation of the read noise, in units of full scale.
        bits: of the converter; None: no rounding.
        clip: limit electrons to the full well, and values to [0, 1].

    Returns:
        Same shape and dtype. Gradients are those of :func:`kornia_tidy.sensor.shot_noise` and
        :func:`kornia_tidy.sensor.quantize`, and zero where a value is clipped.

    Example:
        >>> record(torch.tensor([-0.5, 0.25, 1.5]), read=torch.tensor([0.0, 1.0, 0.0]), sigma=0.5, clip=True)
        tensor([0.0000, 0.7500, 1.0000])
    """
    fields, numbers = (shot, read, offset), (full_well, dark, sigma)
    learnt = any(isinstance(x, Tensor) and x.requires_grad for x in (*fields, *numbers))
    if _goes_in_c(light) and not learnt:
        return _record(light, *fields, float(full_well), float(dark), float(sigma), bits or 0, clip)
    return _record_by_torch(light, *fields, *numbers, bits, clip)


def _record_by_torch(
    light: Tensor,
    shot: Tensor | None,
    read: Tensor | None,
    offset: Tensor | None,
    full_well: float,
    dark: float,
    sigma: float,
    bits: int | None,
    clip: bool,
) -> Tensor:
    value = light
    if shot is not None:
        electrons = drawn_electrons(value.clamp(min=0) * full_well + dark, shot)
        value = ((electrons.clamp(max=full_well) if clip else electrons) - dark) / full_well
    if read is not None:
        value = value + sigma * read
    if offset is not None:
        value = value + offset
    if bits:
        value = quantized(value, bits)
    return value.clamp(0, 1) if clip else value


def quantized(value: Tensor, bits: int) -> Tensor:
    """Return float32 or float64 values rounded to 2^b levels from 0 to 1, with a gradient of one."""
    top = 2**bits - 1
    rounded = (value.detach() * top).round() / top
    return rounded + (value - value.detach())  # adds 0, and a gradient of 1


# ---------------------------------------------------------------------- the operators


def _keep(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    *given, ctx.gradient = inputs
    ctx.options = [None if isinstance(x, Tensor) else x for x in given]
    ctx.save_for_backward(*(x if isinstance(x, Tensor) else None for x in given))


def _backward(ctx: Any, gradient: Tensor, by_operator: Callable[..., Tensor], by_torch: Callable[..., Tensor]) -> Any:
    """Return the gradient of an operator's first argument; the last one is none, or it has been a gradient's."""
    if ctx.gradient is not None:
        raise NotImplementedError(
            "a gradient has no gradient here: differentiate functions of kornia_tidy.sensor instead"
        )
    x, *given = (option if x is None else x for x, option in zip(ctx.saved_tensors, ctx.options, strict=True))
    if torch.is_grad_enabled():  # it is differentiated in turn
        (found,) = differentiable_gradients(lambda own: by_torch(own, *given), [x], gradient, [True])
    else:
        found = by_operator(x, *given, gradient)
    return found, *[None] * (len(given) + 1)


@operator(lambda *given: _backward(*given, _srgb, _convert_by_torch), _keep)
def _srgb(image: Tensor, encode: bool, gradient: Tensor | None = None) -> Iterator[Tensor]:
    return _fill("encode" if encode else "decode", image, gradient)


@operator(lambda *given: _backward(*given, _record, _record_by_torch), _keep)
def _record(
    light: Tensor,
    shot: Tensor | None,
    read: Tensor | None,
    offset: Tensor | None,
    full_well: float,
    dark: float,
    sigma: float,
    bits: int,
    clip: bool,
    gradient: Tensor | None = None,
) -> Iterator[Tensor]:
    return _fill("record", light, gradient, (shot, read, offset), (full_well, dark, sigma, 2**bits - 1, clip))


def _fill(
    function: str,
    x: Tensor,
    gradient: Tensor | None,
    fields: Sequence[Tensor | None] = (None,) * 3,
    numbers: Sequence[float] = (0,) * 5,
) -> Iterator[Tensor]:
    """Yield memory like that of ``x``, and fill it by a function of pixels.c; with a gradient, by its product."""
    given = x, gradient, *fields
    if x.dtype not in REALS:
        raise TypeError(f"values must be float32 or float64, got {x.dtype}")
    for field in given:
        if field is not None and (field.dtype, field.shape) != (x.dtype, x.shape):
            raise ValueError(
                f"fields must be {x.dtype} of shape {tuple(x.shape)} as the values, got {field.dtype} of shape "
                f"{tuple(field.shape)}"
            )
    out = torch.empty_like(x)
    yield out
    # In the order of the result's memory, which may be any.
    ordered = (x if x is None or x.stride() == out.stride() else torch.empty_like(out).copy_(x) for x in given)
    call(getattr(load(SOURCE, x.dtype), function), *((x,) for x in (*ordered, out)), out.numel(), *numbers)
