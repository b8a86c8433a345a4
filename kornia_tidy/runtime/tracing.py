"""Detection of tracing: torch.compile, transforms of torch.func, forward-mode derivatives and torch.jit.

Tracing needs plain operations of torch throughout. C kernels, caches and branches on tensor values are disabled under
tracing.
"""

from __future__ import annotations

from typing import NoReturn

import torch
from torch.autograd import forward_ad

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
    if torch.compiler.is_compiling() or forward_ad._current_level >= 0:
        return True
    return torch._C._functorch.peek_interpreter_stack() is not None


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


def refuse_torchscript() -> NoReturn:
    """Raise the error of TorchScript compilation, which names the alternatives."""
    raise NotImplementedError(TORCHSCRIPT)
