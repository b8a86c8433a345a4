"""Repeatable rendering: the same result to the last bit in every process on one kind of processor."""

from __future__ import annotations

import threading
from collections.abc import Generator
from contextlib import contextmanager

import torch


class _OfThread(threading.local):
    repeatable = False


of_thread = _OfThread()
"""Of the calling thread: whether it renders repeatably."""


@contextmanager
def repeatable() -> Generator[None]:
    """Render by one thread, and choose backends by the shipped cost profile.

    More threads add up sums in other parts. A cost profile that was measured on this machine may choose another
    backend, whose image differs in the last digits, and other processes may not know it.

    Example:
        >>> with repeatable():
        ...     torch.get_num_threads(), of_thread.repeatable
        (1, True)
    """
    threads, before = torch.get_num_threads(), of_thread.repeatable
    of_thread.repeatable = True
    if threads != 1:
        torch.set_num_threads(1)
    try:
        yield
    finally:
        of_thread.repeatable = before
        if threads != 1:
            torch.set_num_threads(threads)
