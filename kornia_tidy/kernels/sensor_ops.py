"""Operator of what a sensor records of light: shot and read noise, saturation and quantisation in one pass, in C.

The formula and the same in plain operations of torch are in :mod:`kornia_tidy.sensor.recording`, which also gives the
operator its gradients.

The operator is defined by schema, as ``torch.library.custom_op`` would import the compiler on the first call (3 s).
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from kornia_tidy.kernels.build import KERNELS, REALS, load
from kornia_tidy.kernels.elementwise import call_elementwise

SOURCE = KERNELS / "sensor.c"
_GIVEN = "Tensor? shot, Tensor? read, Tensor? offset, float full_well, float dark, float sigma, int bits, bool clip"

torch.library.define("kornia_tidy::record", f"(Tensor light, {_GIVEN}) -> Tensor")
torch.library.define("kornia_tidy::record_gradient", f"(Tensor light, Tensor gradient, {_GIVEN}) -> Tensor")


def record_in_c(
    light: Tensor,
    shot: Tensor | None,
    read: Tensor | None,
    offset: Tensor | None,
    full_well: float,
    dark: float,
    sigma: float,
    bits: int,
    clip: bool,
) -> Tensor:
    """Return the values that a sensor reports of light: operator ``kornia_tidy::record``.

    Args:
        light: on a processor, float32 or float64, any shape, 1.0 = full scale.
        shot: uniform random numbers of the light's shape and dtype, or None.
        read: standard normal random numbers, likewise, or None.
        offset: in units of full scale, likewise, or None.
        full_well: electrons at full scale.
        dark: mean dark signal in electrons.
        sigma: standard deviation of the read noise in units of full scale.
        bits: of the converter; 0 for no rounding.
        clip: limit electrons to the full well, and values to [0, 1].

    Returns:
        Same shape and dtype.

    Raises:
        TypeError: if the light is of another dtype.
        ValueError: if a field is not of the light's shape and dtype.
        NotBuiltError: if the source cannot be compiled.
    """
    return torch.ops.kornia_tidy.record(light, shot, read, offset, full_well, dark, sigma, bits, clip)


def _record(light: Tensor, *given: Any) -> Tensor:
    return _call(_new(light, *given), light, None, *given)


def _record_gradient(light: Tensor, gradient: Tensor, *given: Any) -> Tensor:
    return _call(_new(light, gradient, *given), light, gradient, *given)


def _call(out: Tensor, light: Tensor, gradient: Tensor | None, *given: Any) -> Tensor:
    *fields, full_well, dark, sigma, bits, clip = given
    numbers = full_well, dark, sigma, 2**bits - 1, clip
    return call_elementwise(load(SOURCE, out.dtype).record, out, (light, gradient, *fields), *numbers)


def _new(light: Tensor, *given: Any) -> Tensor:
    """Check the arguments and return the memory of the result, which is also the fake implementation."""
    if light.dtype not in REALS:
        raise TypeError(f"light must be float32 or float64, got {light.dtype}")
    for field in given:
        if isinstance(field, Tensor) and (field.dtype, field.shape) != (light.dtype, light.shape):
            raise ValueError(
                f"fields must be {light.dtype} of shape {tuple(light.shape)} as the light, got {field.dtype} of shape "
                f"{tuple(field.shape)}"
            )
    return torch.empty_like(light)


torch.library.impl("kornia_tidy::record", "CPU", _record)
torch.library.register_fake("kornia_tidy::record", _new)
torch.library.impl("kornia_tidy::record_gradient", "CPU", _record_gradient)
torch.library.register_fake("kornia_tidy::record_gradient", _new)
