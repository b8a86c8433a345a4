"""Steps of a recording by themselves: shot noise, and the rounding of a converter."""

from __future__ import annotations

import torch
from torch import Tensor

from kornia_tidy.checks import check_count, check_float_tensor, check_values
from kornia_tidy.kernels.pixel_ops import quantized, record

MOST_BITS = 16  # of a converter


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
    check_count("bits", bits, most=MOST_BITS)
    return quantized(image.to(torch.promote_types(image.dtype, torch.float32)), bits).to(image.dtype)
