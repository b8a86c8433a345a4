"""How torch runs: eagerly, compiled to a graph, under a transform of torch.func, or with values left unread.

Tracing needs plain operations of torch throughout. C kernels, caches and branches on tensor values are disabled under
tracing. Each time a value of an accelerator is read the host waits for it, so a capture reads all its values at once.

Torch keeps its modes for each thread, and so does :func:`values_unread`, the only state of a thread in the package. An
argument cannot carry it: the checks that it skips are in the lens, the PSF model and the renderer, and some of these
are reached through methods of users and operators of torch.
"""

from __future__ import annotations

import threading
from collections.abc import Generator
from contextlib import contextmanager
from enum import Flag, auto
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


class Mode(Flag):
    """How torch runs the current computation: with values, or traced.

    ``EAGER`` excludes the others. ``TRACED`` holds both kinds of tracing, which want plain operations and no caches.
    """

    EAGER = 0
    UNREAD = auto()
    """Values of an accelerator's tensors should be left unread, as the host would wait: see :func:`values_unread`."""
    GRAPH = auto()
    """Values of tensors are unknown: ``torch.compile``, ``export``, ``jit.trace``, ``make_fx`` and ``torch.vmap``."""
    TRANSFORM = auto()
    """Transforms of ``torch.func`` or forward-mode derivatives, compiled or not: C kernels have no rules for them."""
    TRACED = GRAPH | TRANSFORM


class _Thread(threading.local):
    mode = Mode.EAGER


_thread = _Thread()


def torch_mode() -> Mode:
    """Return how torch runs the current computation.

    Example:
        >>> torch.func.grad(lambda x: x * (Mode.TRANSFORM in torch_mode()))(torch.tensor(0.0)), torch_mode()
        (tensor(1.), <Mode.EAGER: 0>)
        >>> torch.vmap(lambda x: x * (Mode.GRAPH in torch_mode()))(torch.ones(2))
        tensor([1., 1.])
    """
    functorch = torch._C._functorch
    unknown = torch.compiler.is_compiling() or torch.jit.is_tracing()
    # make_fx records, as in torch.func.linearize.
    unknown = unknown or torch._C._get_dispatch_mode(torch._C._TorchDispatchModeKey.PROXY) is not None
    # While compiling, the empty stack is a proxy of None, so a comparison with None would fail.
    nested = isinstance(functorch.peek_interpreter_stack(), functorch.CInterpreter)
    if nested and not unknown:
        unknown = any(level.key() == functorch.TransformType.Vmap for level in functorch.get_interpreter_stack() or ())
    if nested or forward_ad._current_level >= 0:
        return Mode.TRACED if unknown else Mode.TRANSFORM
    return Mode.GRAPH if unknown else _thread.mode


@contextmanager
def values_unread(device: torch.device) -> Generator[None]:
    """Skip checks that read values of an accelerator's tensors, in this thread: the caller has made them or needs none.

    Nothing changes for tensors of the CPU and where torch traces the computation.

    Args:
        device: of the tensors.

    Example:
        >>> with values_unread(torch.device("cuda")):
        ...     torch_mode()
        <Mode.UNREAD: 1>
    """
    before = _thread.mode
    if device.type != "cpu" and torch_mode() == Mode.EAGER:
        _thread.mode = Mode.UNREAD
    try:
        yield
    finally:
        _thread.mode = before


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


def refuse_onnx() -> None:
    """Raise ``NotImplementedError`` in an export to ONNX, which has no operators of cameras."""
    if torch.onnx.is_in_onnx_export():
        raise NotImplementedError(
            "a programmable camera cannot become ONNX, which has no rendering by depth: export it with "
            "torch.export.export(optics, (image, depth)), and networks for its captures by torch.onnx.export"
        )
