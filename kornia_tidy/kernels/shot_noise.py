"""Poisson draws of electrons from uniform random numbers by plain operations of torch, with a gradient for the mean."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kornia_tidy.kernels.precision import widest
from kornia_tidy.mode import Mode, torch_mode

# Expected electrons from which a Gaussian replaces the Poisson distribution. Its mean and variance are exact; its skew
# is not. Rounded to whole electrons, it differs by 0.025 in total variation at this count (0.040 at 10, 0.018 at 50).
# It is below zero, where it is clamped, with probability 3e-7 (8e-4 at 10), which biases the mean by 3e-7 electrons.
GAUSSIAN_FROM = 25.0

_MAX_COUNT = 80  # P(more than 72 | 25 expected) is 7e-15, the tail that poisson_quantile neglects


def drawn_electrons(rate: Tensor, uniform: Tensor) -> Tensor:
    """Return the electrons of :func:`~kornia_tidy.sensor.shot_noise`, by plain operations of torch.

    Args:
        rate: expected electrons, not negative, float32 or float64, any shape.
        uniform: uniform random numbers, same shape and dtype.
    """
    dim = rate < GAUSSIAN_FROM
    draw = _dim_counts_operator if torch.compiler.is_compiling() else _dim_counts
    counted = draw(rate.detach(), uniform.detach()) + (rate - rate.detach())  # adds 0, and a gradient of 1
    bright = torch.where(dim, GAUSSIAN_FROM, rate)  # the square root has an infinite derivative at zero
    gaussian = (bright + bright.sqrt() * _normal_quantile(uniform)).clamp(min=0)
    return torch.where(dim, counted, gaussian)


def poisson_quantile(rate: Tensor, uniform: Tensor) -> Tensor:
    r"""Return the quantile of the Poisson distribution: the smallest whole k with P(X <= k) >= u.

    The probabilities are summed term by term.

    Args:
        rate: the mean λ in [0, 25), any shape.
        uniform: u in [0, 1], same shape and dtype. Values within 32 ``eps`` of 1 give the same count, because the sum
            of the terms is exact to a few ``eps`` only.

    Returns:
        k, same shape and dtype, without gradient.

    Example:
        >>> poisson_quantile(torch.tensor([1.0, 1.0]), torch.tensor([0.36, 0.37]))  # P(X = 0) = 0.3679
        tensor([0., 1.])
    """
    uniform = uniform.clamp(max=1 - 32 * torch.finfo(rate.dtype).eps)
    term = torch.exp(-rate)
    below = term.clone()  # P(X < k)
    count = torch.zeros_like(rate)
    for k in range(1, _MAX_COUNT + 1):
        more = uniform > below
        if not _unread(rate) and not bool(more.any()):
            break
        count = count + more
        term *= rate
        term /= k
        below += term
    return count


def _dim_counts(rate: Tensor, uniform: Tensor) -> Tensor:
    """Return Poisson counts where ``rate`` is below ``GAUSSIAN_FROM``, zero elsewhere."""
    wide = widest(rate.device)  # float32 sums change the count of one pixel in 3e5, so devices would disagree
    dim = rate < GAUSSIAN_FROM
    if _unread(rate):
        every = poisson_quantile(torch.where(dim, rate, 0).to(wide), uniform.to(wide))
        return torch.where(dim, every, 0).to(rate.dtype)
    count = torch.zeros_like(rate)
    count[dim] = poisson_quantile(rate[dim].to(wide), uniform[dim].to(wide)).to(rate.dtype)
    return count


# A custom operator for compiled graphs: the loop ends when the values allow, and tracing all its terms takes inductor
# 90 s. Eager code does not use it, because the first call of a custom operator imports the compiler (2 s).
_dim_counts_operator = torch.library.custom_op(
    "kornia_tidy::dim_counts", _dim_counts, mutates_args=(), schema="(Tensor rate, Tensor uniform) -> Tensor"
)
_dim_counts_operator.register_fake(lambda rate, _uniform: torch.empty_like(rate))


def _unread(tensor: Tensor) -> bool:
    """Return whether values cannot be read back: while a CUDA graph is recorded, and under ``torch.vmap``."""
    return Mode.GRAPH in torch_mode() or (tensor.is_cuda and torch.cuda.is_current_stream_capturing())


def _normal_quantile(uniform: Tensor) -> Tensor:
    """Return the normal quantile Φ⁻¹(u), also finite for u = 0 and 1. More devices have erfinv than ndtri."""
    eps = torch.finfo(uniform.dtype).eps
    inside = uniform.clamp(eps / 4, 1 - eps / 2)  # 2u - 1 is then exact on the grid of random numbers, and never ±1
    return math.sqrt(2) * torch.erfinv(2 * inside - 1)
