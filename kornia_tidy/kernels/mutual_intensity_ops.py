r"""Operator of the energy of many waves by their mutual intensity in C.

.. math:: E_d = \sum_k w_k \, |K_d U_k K_d^T|^2

The formula and its derivation are in :mod:`kornia_tidy.psf.energies`. The gradient of the field is also computed in C.
Those of weights and kernels, and gradients of gradients, are made of the waves, one depth at a time.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import torch
from torch import Tensor

from kornia_tidy.kernels.build import KERNELS, load
from kornia_tidy.kernels.operators import call, check, differentiable_gradients, operator

SOURCE = KERNELS / "mutual_intensity.c"


def _keep(ctx: Any, inputs: tuple[Tensor, Tensor, Tensor], output: Tensor) -> None:
    ctx.save_for_backward(*inputs)


def _by_torch(field: Tensor, weights: Tensor, kernels: Tensor) -> Tensor:
    """Return the energies of the waves :math:`K U K^T`, formed one by one."""
    window, order = kernels.shape[1:3]
    waves = [kernel @ field @ kernel.mT for kernel in kernels.flatten(1, 2)]
    energies = [torch.tensordot(weights, wave.real.square() + wave.imag.square(), 1) for wave in waves]
    return torch.stack(energies).view(-1, window, order, window, order).sum((2, 4))


def _backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
    wanted = ctx.needs_input_grad
    if not torch.is_grad_enabled() and not any(wanted[1:]):
        return torch.ops.kornia_tidy.mutual_field_gradient(*ctx.saved_tensors, gradient), None, None
    return tuple(differentiable_gradients(_by_torch, ctx.saved_tensors, gradient, wanted))


@operator(_backward, _keep)
def mutual_intensity_energies(field: Tensor, weights: Tensor, kernels: Tensor) -> Iterator[Tensor]:
    r"""Return :math:`\sum_{k,q,q'} w_k |K_d U_k K_d^T|^2`: operator ``kornia_tidy::mutual_intensity_energies``.

    Args:
        field: U, (K, N, N) complex64 or complex128 on a processor.
        weights: w, (K,), of the field's real dtype.
        kernels: (D, P, q, N), of the field's dtype.

    Returns:
        (D, P, P), real, summed over the q points of a pixel on each axis, never negative. It has gradients with respect
        to all three, which can be differentiated in turn.

    Raises:
        TypeError: if a data type is not as above.
        ValueError: if shapes do not fit.
        MemoryError: if memory for a row of pixels is missing.
        NotBuiltError: if the source cannot be compiled.
    """
    if field.dtype not in (torch.complex64, torch.complex128):
        raise TypeError(f"field must be complex64 or complex128, got {field.dtype}")
    sizes: dict[str, int] = {}
    check(sizes, field.dtype, field=(field, "K N N"), kernels=(kernels, "D P q N"))
    check(sizes, field.dtype.to_real(), weights=(weights, "K"))
    energies = weights.new_empty(kernels.shape[0], kernels.shape[1], kernels.shape[1])
    yield energies
    numbers = field.shape[0], *kernels.shape
    call(load(SOURCE, weights.dtype).mutual_energies, *numbers, field, weights, kernels, None, energies)


@operator()
def mutual_field_gradient(field: Tensor, weights: Tensor, kernels: Tensor, gradient: Tensor) -> Iterator[Tensor]:
    """Return the gradient of the field, (K, N, N), from that of the energies; summed in the same order every time."""
    found = torch.empty_like(field, memory_format=torch.contiguous_format)
    yield found
    numbers = field.shape[0], *kernels.shape
    call(load(SOURCE, weights.dtype).mutual_field_gradient, *numbers, field, weights, kernels, gradient, found)
