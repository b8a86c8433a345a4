"""Operators on any device whose gradient is a second operator: it makes the result again, from only the arguments.

A compiled graph then holds two operators where a compiler would unfold everything that they do.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from kornia_tidy.kernels.operators import define, differentiable_gradients
from kornia_tidy.mode import recording_in_operator


def define_recomputed(
    name: str,
    schema: str,
    tensors: int,
    compute: Callable[..., Tensor],
    fake: Callable[..., Tensor],
    pairs: Callable[..., Sequence[tuple[Tensor, Tensor]]],
    plain: Callable[..., Tensor],
) -> None:
    """Define operators ``kornia_tidy::<name>`` and ``kornia_tidy::<name>_gradients``.

    Args:
        name: of the operator.
        schema: its arguments, as ``torch.library.define`` takes them, without brackets.
        tensors: number of the first arguments, which are tensors or None.
        compute: the implementation.
        fake: returns the memory of the result, also for tensors without memory.
        pairs: takes the arguments and the gradient of the result; returns tensors made of the arguments, and their
            gradients, from which autograd goes on.
        plain: computes the result by operations of torch that are twice differentiable.
    """

    def gradients(*arguments: Any) -> list[Tensor]:
        *options, gradient, wanted = arguments[tensors:]
        given = zip(arguments[:tensors], wanted, strict=True)
        own: list[Any] = [None if x is None else x.detach().requires_grad_(want) for x, want in given]
        leaves = [x for x in own if x is not None and x.requires_grad]
        found: Sequence[Tensor | None] = [None] * len(leaves)
        with recording_in_operator(), torch.autocast(gradient.device.type, enabled=False):
            if known := pairs(*own, *options, gradient):
                made, of_made = zip(*known, strict=True)
                found = torch.autograd.grad(made, leaves, of_made, allow_unused=True)
        return [
            torch.zeros_like(leaf, memory_format=torch.contiguous_format) if x is None else x.contiguous()
            for x, leaf in zip(found, leaves, strict=True)
        ]

    def gradients_fake(*arguments: Any) -> list[Tensor]:
        given = zip(arguments[:tensors], arguments[-1], strict=True)
        return [x.new_empty(x.shape) for x, want in given if want and x is not None]

    def keep(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.save_for_backward(*inputs[:tensors])
        ctx.options = inputs[tensors:]

    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        given, options, rest = ctx.saved_tensors, ctx.options, [None] * len(ctx.options)
        wanted = list(ctx.needs_input_grad[:tensors])
        if torch.is_grad_enabled():  # it is differentiated in turn
            with torch.autocast(gradient.device.type, enabled=False):
                return *differentiable_gradients(lambda *x: plain(*x, *options), given, gradient, wanted), *rest
        found = iter(getattr(torch.ops.kornia_tidy, f"{name}_gradients")(*given, *options, gradient, wanted))
        return *(next(found) if want else None for want in wanted), *rest

    define(name, f"({schema}) -> Tensor", compute, fake, backward, keep, "default")
    asks = f"({schema}, Tensor gradient, bool[] wanted) -> Tensor[]"
    define(f"{name}_gradients", asks, gradients, gradients_fake, devices="default")
