"""Gradients of PSFs without the PSFs: energies stay zero where only their gradients are asked for.

A backward pass that records PSFs anew needs them only for the record: they are linear in the energies of light, whose
gradients do not depend on their values. Leaving them out saves a fifth of the time.
"""

from __future__ import annotations

import threading
from collections.abc import Generator
from contextlib import contextmanager


class _Thread(threading.local):
    active = False


_thread = _Thread()


@contextmanager
def gradients_only() -> Generator[None]:
    """Leave energies zero in this thread.

    Example:
        >>> with gradients_only():
        ...     is_gradients_only()
        True
    """
    before, _thread.active = _thread.active, True
    try:
        yield
    finally:
        _thread.active = before


def is_gradients_only() -> bool:
    """Return whether energies are to be left zero.

    Example:
        >>> is_gradients_only()
        False
    """
    return _thread.active
