"""Operators in C that compute each number of a tensor from the numbers in the same place of others."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from kornia_tidy.kernels.build import REALS
from kornia_tidy.kernels.operators import define


def define_elementwise(
    name: str, schema: str, tensors: int, call: Callable[..., Tensor], by_torch: Callable[..., Tensor]
) -> None:
    """Define an operator ``kornia_tidy::<name>`` of a first tensor, with its gradient ``kornia_tidy::<name>_gradient``.

    Args:
        name: of the operator.
        schema: its arguments. The first is a tensor; the gradient's operator has that of its result after it.
        tensors: how many arguments are tensors; they come first. Gradients reach the first.
        call: fills the memory of the result, which comes first, from the first tensor, the gradient of the result or
            None, and all other arguments.
        by_torch: the same by plain operations, of the operator's arguments, to differentiate the gradient in turn.
    """
    first, _, rest = schema.partition(", ")
    of_gradient = f"{name}_gradient"

    def new(x: Tensor, *given: Any) -> Tensor:
        """Check the arguments and return the memory of the result, which is also the fake implementation."""
        if x.dtype not in REALS:
            raise TypeError(f"{first.split()[1]} must be float32 or float64, got {x.dtype}")
        for field in given:
            if isinstance(field, Tensor) and (field.dtype, field.shape) != (x.dtype, x.shape):
                raise ValueError(
                    f"fields must be {x.dtype} of shape {tuple(x.shape)} as the {first.split()[1]}, got {field.dtype} "
                    f"of shape {tuple(field.shape)}"
                )
        return torch.empty_like(x)

    def gradient_of(x: Tensor, gradient: Tensor, *given: Any) -> Tensor:
        return call(new(x, gradient, *given), x, gradient, *given)

    def keep(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.save_for_backward(*inputs[:tensors])
        ctx.options = inputs[tensors:]

    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        x, *fields = ctx.saved_tensors
        given = *fields, *ctx.options
        if not torch.is_grad_enabled():
            return getattr(torch.ops.kornia_tidy, of_gradient)(x, gradient, *given), *[None] * len(given)
        own = x.view_as(x)  # the gradient is differentiated in turn
        return *torch.autograd.grad(by_torch(own, *given), own, gradient, create_graph=True), *[None] * len(given)

    schemas = f"({schema}) -> Tensor", f"({first}, Tensor gradient, {rest}) -> Tensor"
    define(name, schemas[0], lambda x, *given: call(new(x, *given), x, None, *given), new, backward, keep)
    define(of_gradient, schemas[1], gradient_of, new)


def call_elementwise(
    function: Callable[..., Any], out: Tensor, given: Sequence[Tensor | None], *numbers: float
) -> Tensor:
    """Fill a tensor by a function of C, and return it.

    Args:
        function: takes the addresses of the given tensors and of ``out``, the count of their numbers, the other
            arguments, and the number of threads.
        out: dense, of float32 or float64.
        given: of its shape and type, in any order of memory. None is a null pointer.
        numbers: floats and whole numbers for the function.
    """
    ordered = [None if x is None else _in_order(x, out) for x in given]
    function(
        *(ctypes.c_void_p(None if x is None else x.data_ptr()) for x in (*ordered, out)),
        ctypes.c_int64(out.numel()),
        *(ctypes.c_double(x) if isinstance(x, float) else ctypes.c_int64(x) for x in numbers),
        ctypes.c_int64(torch.get_num_threads()),
    )
    return out


def _in_order(x: Tensor, out: Tensor) -> Tensor:
    """Return numbers that lie in memory as those of a dense tensor do."""
    x = x.resolve_neg()
    return x if x.stride() == out.stride() else torch.empty_like(out).copy_(x)
