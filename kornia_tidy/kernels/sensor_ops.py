r"""Recording: the values that a sensor reports of light, as an operator in C for processors, in torch for all else.

.. math::
    N = \mathrm{Poisson}(w \max(x, 0) + d), \qquad
    y = \mathrm{clip}_0^1 \, q\!\left( \frac{\min(N, w) - d}{w} + \sigma n + o \right)

with the light x, full well w, dark signal d, read noise :math:`\sigma n`, offset o and the converter q. The random
numbers are given, so that the same ones give the same values. With and without the operator these are equal to the last
bit, but where more than 25 electrons are drawn they differ by rounding, and one in 1e5 by a level of the converter.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from kornia_tidy.kernels.build import KERNELS, REALS, compiled, load
from kornia_tidy.kernels.elementwise import call_elementwise, define_elementwise
from kornia_tidy.kernels.shot_noise import drawn_electrons
from kornia_tidy.mode import Mode, torch_mode

SOURCE = KERNELS / "sensor.c"


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
    here = light.device.type == "cpu" and light.dtype in REALS and not (learnt or torch_mode() & Mode.TRACED)
    if here and compiled(SOURCE, light.dtype) is not None:
        return torch.ops.kornia_tidy.record(light, *fields, *map(float, numbers), bits or 0, clip)
    return _by_torch(light, *fields, *numbers, bits, clip)


def _by_torch(
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


# ---------------------------------------------------------------------- the operator


def _call(out: Tensor, light: Tensor, gradient: Tensor | None, *given: Any) -> Tensor:
    *fields, full_well, dark, sigma, bits, clip = given
    numbers = full_well, dark, sigma, 2**bits - 1, clip
    return call_elementwise(load(SOURCE, out.dtype).record, out, (light, gradient, *fields), *numbers)


_GIVEN = "Tensor? shot, Tensor? read, Tensor? offset, float full_well, float dark, float sigma, int bits, bool clip"
define_elementwise("record", f"Tensor light, {_GIVEN}", 4, _call, _by_torch)
