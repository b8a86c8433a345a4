r"""Operator of the energy of many waves by their mutual intensity in C.

.. math:: E_d = \sum_k w_k \, |K_d U_k K_d^T|^2

The formula and its derivation are in :mod:`kornia_tidy.psf.energies`. The gradient of the field is also computed in C.
Those of weights and kernels, and gradients of gradients, are made of the waves, one depth at a time.
"""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from torch import Tensor

from kornia_tidy.kernels.build import KERNELS, load
from kornia_tidy.kernels.operators import define, differentiable_gradients

SOURCE = KERNELS / "mutual_intensity.c"


def mutual_intensity_energies(field: Tensor, weights: Tensor, kernels: Tensor) -> Tensor:
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
    return torch.ops.kornia_tidy.mutual_intensity_energies(field, weights, kernels)


def _new_energies(field: Tensor, weights: Tensor, kernels: Tensor) -> Tensor:
    """Check the arguments and return the memory of the result, which is also the fake implementation."""
    if field.dtype not in (torch.complex64, torch.complex128):
        raise TypeError(f"field must be complex64 or complex128, got {field.dtype}")
    if kernels.dtype != field.dtype:
        raise TypeError(f"kernels must be of the field's dtype {field.dtype}, got {kernels.dtype}")
    if weights.dtype != field.dtype.to_real():
        raise TypeError(f"weights must be of the field's real dtype {field.dtype.to_real()}, got {weights.dtype}")
    if field.ndim != 3 or field.shape[1] != field.shape[2]:
        raise ValueError(f"field must have shape (K, N, N), got {tuple(field.shape)}")
    if tuple(weights.shape) != (field.shape[0],):
        raise ValueError(f"weights must have shape {(field.shape[0],)}, got {tuple(weights.shape)}")
    if kernels.ndim != 4 or kernels.shape[-1] != field.shape[-1]:
        raise ValueError(f"kernels must have shape (D, P, q, {field.shape[-1]}), got {tuple(kernels.shape)}")
    return weights.new_empty(kernels.shape[0], kernels.shape[1], kernels.shape[1])


def _energies(field: Tensor, weights: Tensor, kernels: Tensor) -> Tensor:
    energies = _new_energies(field, weights, kernels)
    return _call("mutual_energies", energies, field, weights, kernels)


def _new_gradient(field: Tensor, weights: Tensor, kernels: Tensor, gradient: Tensor) -> Tensor:
    return torch.empty_like(field, memory_format=torch.contiguous_format)


def _field_gradient(field: Tensor, weights: Tensor, kernels: Tensor, gradient: Tensor) -> Tensor:
    """Return (K, N, N), summed in the same order every time."""
    out = _new_gradient(field, weights, kernels, gradient)
    return _call("mutual_field_gradient", out, field, weights, kernels, gradient)


def _call(function: str, out: Tensor, field: Tensor, weights: Tensor, kernels: Tensor, *gradient: Tensor) -> Tensor:
    """Call a function of mutual_intensity.c that writes to ``out``, and return it."""
    given = [x.resolve_conj().contiguous() for x in (field, weights, kernels, *gradient)]
    depths, window, order, cells = kernels.shape
    failed = getattr(load(SOURCE, weights.dtype), function)(
        *(ctypes.c_void_p(x.data_ptr()) for x in (*given, out)),
        *map(ctypes.c_int64, (len(field), depths, window, order, cells, torch.get_num_threads())),
    )
    if failed:
        raise MemoryError(f"no memory for PSFs of {window}x{window} pixels")
    return out


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


_WAVES = "Tensor field, Tensor weights, Tensor kernels"
define("mutual_intensity_energies", f"({_WAVES}) -> Tensor", _energies, _new_energies, _backward, _keep)
define("mutual_field_gradient", f"({_WAVES}, Tensor gradient) -> Tensor", _field_gradient, _new_gradient)
