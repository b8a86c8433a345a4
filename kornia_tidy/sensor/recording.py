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

from kornia_tidy.checks import check_float_tensor, check_values
from kornia_tidy.kernels.build import REALS, compiled
from kornia_tidy.kernels.sensor_ops import SOURCE, record_in_c
from kornia_tidy.runtime.mode import Mode, torch_mode
from kornia_tidy.sensor.shot import drawn_electrons


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
        Same shape and dtype. Gradients are those of :func:`shot_noise` and :func:`quantize`, and zero where a value is
        clipped.

    Example:
        >>> record(torch.tensor([-0.5, 0.25, 1.5]), read=torch.tensor([0.0, 1.0, 0.0]), sigma=0.5, clip=True)
        tensor([0.0000, 0.7500, 1.0000])
    """
    fields, numbers = (shot, read, offset), (full_well, dark, sigma)
    learnt = any(isinstance(x, Tensor) and x.requires_grad for x in (*fields, *numbers))
    here = light.device.type == "cpu" and light.dtype in REALS and not (learnt or torch_mode() & Mode.TRACED)
    if here and compiled(SOURCE, light.dtype) is not None:
        return record_in_c(light, *fields, *map(float, numbers), bits or 0, clip)
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
        value = quantize(value, bits)
    return value.clamp(0, 1) if clip else value


def shot_noise(electrons: Tensor, uniform: Tensor) -> Tensor:
    r"""Draw shot noise by inversion: the quantile of the Poisson distribution at a uniform random number.

    .. math::
        k = \begin{cases}
            \min\{k : P(X \le k) \ge u\}, \; X \sim \mathrm{Poisson}(\lambda) & \lambda < 25 \\
            \max(0, \lambda + \sqrt{\lambda} \, \Phi^{-1}(u)) & \lambda \ge 25
        \end{cases}

    Args:
        electrons: expected electrons λ, any shape. Negative values (FFT round-off) count as zero.
        uniform: uniform random numbers u in [0, 1], same shape; the same u gives the same draw.

    Returns:
        Electrons, same shape and dtype as ``electrons``, computed in float32 or wider, never negative. Below λ = 25
        they are whole numbers; from 25 on they are not rounded. λ = 0 gives exactly 0.

    Raises:
        ValueError: if the two shapes differ.

    Convention:
        - The gradient below 25 is a straight-through estimate: dk/dλ = 1, the derivative of the mean.
        - The gradient from 25 on is that of the formula, 1 + Φ⁻¹(u) / (2 √λ). It is zero for λ < 0 and where the draw
          is clamped at 0.

    Source: inversion by sequential search, Devroye, Non-Uniform Random Variate Generation (1986), III.2.

    Example:
        >>> shot_noise(torch.tensor([0.0, 2.0, 2.0, 900.0]), torch.tensor([0.9, 0.1, 0.9, 0.5]))
        tensor([  0.,   0.,   4., 900.])
    """
    check_values("electrons", electrons)
    if uniform.shape != electrons.shape:
        raise ValueError(
            f"uniform must have the shape of electrons, {tuple(electrons.shape)}, got {tuple(uniform.shape)}"
        )
    rate = electrons.to(torch.promote_types(electrons.dtype, torch.float32))
    return record(rate, uniform.to(rate.dtype)).to(electrons.dtype)


def quantize(image: Tensor, bits: int) -> Tensor:
    r"""Quantise values to the levels of an analogue-to-digital converter.

    .. math:: q(x) = \mathrm{round}\left( x \, (2^b - 1) \right) / (2^b - 1)

    Args:
        image: values, any shape; 1.0 is the highest level.
        bits: bits b of the converter, 1 to 16.

    Returns:
        Rounded values, same shape and dtype. [0, 1] has the levels 0 to 2^b - 1. Values outside are rounded in the same
        steps and not clipped.

    Raises:
        TypeError: if ``image`` is not a floating-point tensor.
        ValueError: if ``bits`` is not a whole number from 1 to 16.

    Convention:
        - The gradient is a straight-through estimate: dq/dx = 1 everywhere.

    Example:
        >>> quantize(torch.tensor([0.0, 0.2, 0.6, 1.0, 1.2]), bits=2) * 3
        tensor([0., 1., 2., 3., 4.])
    """
    check_float_tensor("image", image, image.ndim, "")
    check_bits(bits)
    value = image.to(torch.promote_types(image.dtype, torch.float32))
    top = 2**bits - 1
    rounded = (value.detach() * top).round() / top
    return (rounded + (value - value.detach())).to(image.dtype)  # adds 0, and a gradient of 1


def check_bits(bits: int) -> None:
    """Raise ``ValueError`` unless this is a number of bits that a converter may have."""
    if not isinstance(bits, int) or not 1 <= bits <= 16:
        raise ValueError(f"bits must be a whole number from 1 to 16, got {bits}")


def _keep(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    ctx.save_for_backward(*inputs[:4])
    ctx.options = inputs[4:]


def _backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
    light, *fields = ctx.saved_tensors
    given = *fields, *ctx.options
    if not torch.is_grad_enabled():
        return torch.ops.kornia_tidy.record_gradient(light, gradient, *given), *[None] * len(given)
    own = light.view_as(light)  # the gradient is differentiated in turn
    return *torch.autograd.grad(_by_torch(own, *given), own, gradient, create_graph=True), *[None] * len(given)


torch.library.register_autograd("kornia_tidy::record", _backward, setup_context=_keep)
