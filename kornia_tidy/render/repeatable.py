"""Repeatable rendering: the same result to the last bit in every process on one kind of processor."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager

import torch


@contextmanager
def repeatable() -> Generator[None]:
    """Render by one thread: more threads add up sums in other parts.

    Example:
        >>> with repeatable():
        ...     torch.get_num_threads()
        1
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
