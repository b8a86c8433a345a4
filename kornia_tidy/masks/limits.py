r"""Limits of height: what can be made has a lowest and a highest place. Phases here are radians at 530 nm.

With the largest phase m and a free phase :math:`\varphi`:

- clamp: :math:`\min(\max(\varphi + m/2, 0), m)`; beyond a limit only gradients that lead back pass.
- sigmoid: :math:`m / (1 + e^{-4\varphi/m})`, of slope 1 in the middle of the range, so a learning rate keeps its unit.
- wrapped: :math:`\varphi \bmod m`; the gradient is that of the free phase, which passes over the steps. Where m is a
  whole number of waves, as it is by default, light at 530 nm does not see them.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

CONSTRAINTS = ("none", "clamp", "sigmoid", "wrapped")
_SIGMOID_REACH = 1e-3  # of the range: a sigmoid comes to its ends only at infinity


def limited_phase(free: Tensor, constraint: str, max_phase: float) -> Tensor:
    """Return a phase between 0 and ``max_phase``.

    Args:
        free: any phase in radians.
        constraint: one of ``CONSTRAINTS``.
        max_phase: in radians.

    Example:
        >>> free = torch.tensor([-4.0, 0.0, 1.0, 7.0])
        >>> limited_phase(free, "clamp", 6.0)
        tensor([0., 3., 4., 6.])
        >>> limited_phase(free, "wrapped", 6.0)
        tensor([2., 0., 1., 1.])
    """
    if constraint == "clamp":
        return _Clamp.apply(free + max_phase / 2, max_phase)
    if constraint == "sigmoid":
        return max_phase * torch.sigmoid(free * (4 / max_phase))
    return free.remainder(max_phase) if constraint == "wrapped" else free


def unlimited_phase(phase: Tensor, constraint: str, max_phase: float) -> Tensor:
    """Return a free phase that :func:`limited_phase` takes to this one, or as near as the limits allow.

    Example:
        >>> phase = torch.tensor([0.5, 3.0, 5.5])
        >>> limited_phase(unlimited_phase(phase, "sigmoid", 6.0), "sigmoid", 6.0)
        tensor([0.5000, 3.0000, 5.5000])
    """
    if constraint == "clamp":
        return phase - max_phase / 2
    if constraint == "sigmoid":
        return torch.logit(phase / max_phase, eps=_SIGMOID_REACH) * (max_phase / 4)
    return phase


class _Clamp(torch.autograd.Function):
    """Clamp to [0, limit]; a value beyond an end feels a descent that leads back, but none that leads further out."""

    generate_vmap_rule = True

    @staticmethod
    def forward(value: Tensor, limit: float) -> Tensor:
        return value.clamp(0, limit)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, float], output: Tensor) -> None:
        value, limit = inputs
        ctx.save_for_backward((value < 0).to(value) - (value > limit).to(value))  # the way back: +1, -1, or 0

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor, None]:
        (gradient,), (back,) = grad_outputs, ctx.saved_tensors
        return gradient * (back * gradient <= 0), None  # descent goes against the gradient
