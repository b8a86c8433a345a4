"""Detection of tracing: torch.compile, transforms of torch.func, forward-mode derivatives and torch.jit.

Tracing needs plain operations of torch throughout. C kernels, caches and branches on tensor values are disabled under
tracing.
"""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from typing import NoReturn

import torch
from torch.autograd import forward_ad

_KEYS_OF_RECORDING = tuple(
    getattr(torch._C.DispatchKey, name)
    for name in (
        *("AutogradFunctionality", "AutogradOther", "AutogradNestedTensor", "ADInplaceOrView"),
        *("Conjugate", "Negative", "ZeroTensor"),
    )
)
TORCHSCRIPT = (
    "a programmable camera cannot become TorchScript, which knows no PSFs computed from masks: export it with "
    "torch.export.export(optics, (image, depth)), or compile it with torch.compile"
)


def is_followed() -> bool:
    """Return whether torch traces the computation, so that it must use plain operations and no caches.

    Example:
        >>> torch.func.grad(lambda x: x * is_followed())(torch.tensor(0.0)), is_followed()
        (tensor(1.), False)
    """
    return torch.compiler.is_compiling() or is_transformed()


def is_transformed() -> bool:
    """Whether torch.func or forward-mode derivatives need plain operations of torch, compiled or not.

    Example:
        >>> torch.func.grad(lambda x: x * is_transformed())(torch.tensor(0.0)), is_transformed()
        (tensor(1.), False)
    """
    functorch = torch._C._functorch
    # While compiling, the empty stack is a proxy of None, so a comparison with None would fail.
    return forward_ad._current_level >= 0 or isinstance(functorch.peek_interpreter_stack(), functorch.CInterpreter)


def is_value_unknown() -> bool:
    """Return whether tensor values are unavailable: under compilation, tracing and ``torch.vmap``.

    Example:
        >>> torch.vmap(lambda x: x * is_value_unknown())(torch.ones(2)), is_value_unknown()
        (tensor([1., 1.]), False)
    """
    if torch.compiler.is_compiling() or torch.jit.is_tracing():
        return True
    functorch = torch._C._functorch
    if functorch.peek_interpreter_stack() is None:
        return False
    return any(level.key() == functorch.TransformType.Vmap for level in functorch.get_interpreter_stack() or ())


@contextmanager
def recording_in_operator() -> Generator[None]:
    """Let autograd record inside the implementation of an operator.

    Where a dispatch mode is active, such as a counter of operations, torch calls implementations with autograd and lazy
    conjugation switched off. Here both are on.

    Example:
        >>> x = torch.ones(1, requires_grad=True)
        >>> with torch.no_grad(), recording_in_operator():
        ...     (2 * x).requires_grad
        True
    """
    included, excluded = torch._C._dispatch_tls_local_include_set(), torch._C._dispatch_tls_local_exclude_set()
    for key in _KEYS_OF_RECORDING:
        excluded = excluded.remove(key)
    with torch._C._ForceDispatchKeyGuard(included, excluded), torch.enable_grad():
        yield


def refuse_torchscript() -> NoReturn:
    """Raise the error of TorchScript compilation, which names the alternatives."""
    raise NotImplementedError(TORCHSCRIPT)
