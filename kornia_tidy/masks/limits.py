r"""Height limits: a free phase is clamped, compressed or wrapped to the range that a mask can have.

Phases are radians at 530 nm. With the largest phase m and a free phase :math:`\varphi`:

- clamp: :math:`\min(\max(\varphi + m/2, 0), m)`. Beyond a limit, gradients pass only if descent leads back.
- sigmoid: :math:`m / (1 + e^{-4\varphi/m})`. Its gradient is 1 in the middle of the range, so a learning rate keeps
  its unit.
- wrapped: :math:`\varphi \bmod m`. Its gradient is 1 everywhere; the jumps are ignored. If m is a whole number of
  waves, which is the default, the jumps have no effect at 530 nm.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

CONSTRAINTS = ("none", "clamp", "sigmoid", "wrapped")
_SIGMOID_MARGIN = 1e-3  # of the range; the inverse of a sigmoid is infinite at the ends of the range


def limited_phase(free: Tensor, constraint: str, max_phase: float) -> Tensor:
    """Return a free phase limited to the range from 0 to ``max_phase``.

    Args:
        free: any phase in radians.
        constraint: one of ``CONSTRAINTS``; "none" returns ``free``.
        max_phase: in radians.

    Returns:
        Radians, the shape of ``free``.

    Example:
        >>> free = torch.tensor([-4.0, 0.0, 1.0, 7.0])
        >>> limited_phase(free, "clamp", 6.0)
        tensor([0., 3., 4., 6.])
        >>> limited_phase(free, "wrapped", 6.0)
        tensor([2., 0., 1., 1.])
    """
    if constraint == "clamp":
        return clamped(free + max_phase / 2, max_phase)
    if constraint == "sigmoid":
        return max_phase * torch.sigmoid(free * (4 / max_phase))
    return free.remainder(max_phase) if constraint == "wrapped" else free


def clamped(value: Tensor, limit: float) -> Tensor:
    """Return values clamped to [0, limit], with a gradient beyond the limits only where descent leads back.

    Args:
        value: of any shape.
        limit: in its unit.

    Example:
        >>> clamped(torch.tensor([-1.0, 0.5, 3.0]), 2.0)
        tensor([0.0000, 0.5000, 2.0000])
    """
    return _Clamp.apply(value, limit)


def unlimited_phase(phase: Tensor, constraint: str, max_phase: float) -> Tensor:
    """Return the free phase of a limited phase: an inverse of :func:`limited_phase`.

    Args:
        phase: radians between 0 and ``max_phase``. For "sigmoid", values nearer to an end than a thousandth of the
            range are moved to that distance.
        constraint: one of ``CONSTRAINTS``.
        max_phase: in radians.

    Returns:
        Radians, the shape of ``phase``.

    Example:
        >>> phase = torch.tensor([0.5, 3.0, 5.5])
        >>> limited_phase(unlimited_phase(phase, "sigmoid", 6.0), "sigmoid", 6.0)
        tensor([0.5000, 3.0000, 5.5000])
    """
    if constraint == "clamp":
        return phase - max_phase / 2
    if constraint == "sigmoid":
        return torch.logit(phase / max_phase, eps=_SIGMOID_MARGIN) * (max_phase / 4)
    return phase


class _Clamp(torch.autograd.Function):
    """Clamp to [0, limit], with a gradient beyond the limits only where gradient descent leads back into the range."""

    generate_vmap_rule = True

    @staticmethod
    def forward(value: Tensor, limit: float) -> Tensor:
        return value.clamp(0, limit)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, float], output: Tensor) -> None:
        value, limit = inputs
        ctx.save_for_backward((value < 0).to(value) - (value > limit).to(value))  # direction back: +1, -1, or 0 inside

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, None]:
        (gradient,), (back,) = grad_outputs, ctx.saved_tensors
        return gradient * (back * gradient <= 0), None  # descent goes against the gradient
