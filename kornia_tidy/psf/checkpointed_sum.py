"""Checkpointed sums over blocks: the backward pass computes each block again instead of keeping it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from kornia_tidy.runtime.tracing import is_followed

Energies = Callable[..., Tensor]
Gradients = Callable[..., tuple[Tensor | None, ...]]


def recomputed(energies: Energies, gradients: Gradients, *matrices: Tensor) -> Tensor:
    """Return energies of matrices; only the matrices are kept for the backward pass.

    Args:
        energies: of the matrices.
        gradients: of the matrices, of the gradient of the energies, and of which gradients are needed; the gradients of
            each matrix, None where it is not needed. It is differentiated in turn.
        *matrices: their inputs.
    """
    if is_followed():  # the compiler makes an instance of a Function, which warns; others want one for each of them
        return energies(*matrices)
    return _Recomputed.apply(energies, gradients, *matrices)


class _Recomputed(torch.autograd.Function):
    @staticmethod
    def forward(energies: Energies, gradients: Gradients, *matrices: Tensor) -> Tensor:
        return energies(*matrices)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        _, ctx.gradients, *matrices = inputs
        ctx.save_for_backward(*matrices)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = grad_outputs
        with torch.autocast(gradient.device.type, enabled=False):
            return None, None, *ctx.gradients(*ctx.saved_tensors, gradient, ctx.needs_input_grad[2:])
