"""Calls of C functions that compute each number of a tensor from the numbers in the same place of others."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor


def call_elementwise(
    function: Callable[..., Any], out: Tensor, given: Sequence[Tensor | None], *numbers: float
) -> Tensor:
    """Fill a tensor by a function of C, and return it.

    Args:
        function: takes the addresses of the given tensors and of ``out``, how many numbers they hold, what else is
            given, and the number of threads.
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
