"""Reading values of an accelerator: each time the host waits for it, so a capture reads what it needs at once."""

from __future__ import annotations

import threading
from collections.abc import Generator
from contextlib import contextmanager

import torch

from kornia_tidy.runtime.tracing import is_followed


class _Thread(threading.local):
    unread = False


_thread = _Thread()


@contextmanager
def values_unread(device: torch.device) -> Generator[None]:
    """Skip checks that read values of an accelerator's tensors, in this thread: the caller has made them or needs none.

    Nothing changes for tensors of the CPU and where torch traces the computation.

    Args:
        device: of the tensors.

    Example:
        >>> with values_unread(torch.device("cuda")):
        ...     is_unread()
        True
    """
    before = _thread.unread
    _thread.unread = before or (device.type != "cpu" and not is_followed())
    try:
        yield
    finally:
        _thread.unread = before


def is_unread() -> bool:
    """Return whether values of tensors are to be left unread.

    Example:
        >>> is_unread()
        False
    """
    return _thread.unread
