"""Thread safety of shared cameras: a lock that survives copies, pickles and forks, and notes of each thread."""

from __future__ import annotations

import os
import threading
from collections.abc import Hashable, Iterable
from typing import Any
from weakref import WeakSet

from torch import Tensor

_RLock: Any = type(threading.RLock())  # a lock in C, of which the typing stubs say that it cannot be inherited from


class SharedLock(_RLock):
    """A re-entrant lock for objects that are copied, pickled and carried into forked processes.

    A copy has a new lock. So has a forked child, since the thread that held the lock does not exist there.

    Example:
        >>> import copy
        >>> lock = SharedLock()
        >>> with lock, copy.deepcopy(lock), lock:
        ...     pass
    """

    def __init__(self) -> None:
        super().__init__()
        _LOCKS.add(self)

    def __reduce__(self) -> tuple[type[SharedLock], tuple[()]]:
        """Copy and pickle as a new, open lock."""
        return SharedLock, ()


_LOCKS: WeakSet[SharedLock] = WeakSet()


def _open_locks() -> None:
    for lock in _LOCKS:
        lock._at_fork_reinit()  # as threading does with its own


if hasattr(os, "register_at_fork"):  # Windows has no fork
    os.register_at_fork(after_in_child=_open_locks)


class CaptureNotes:
    """Record of a camera's captures: clamped pixels of each thread's last capture, and warnings already given.

    Args:
        told: warnings that were given before.

    Example:
        >>> notes = CaptureNotes()
        >>> notes.first_time("clamped"), notes.first_time("clamped")
        (True, False)
    """

    def __init__(self, told: Iterable[Hashable] = ()) -> None:
        self._told: dict[Hashable, object] = dict.fromkeys(told)
        self.of_thread = threading.local()
        """Of the calling thread: ``clamped``, the number of clamped pixels in its last capture."""

    def first_time(self, warning: Hashable) -> bool:
        """Return True the first time that a warning is requested, in any thread."""
        mine = object()
        return self._told.setdefault(warning, mine) is mine  # atomic in the interpreter

    def is_told(self, warning: Hashable) -> bool:
        """Return whether a warning was given."""
        return warning in self._told

    @property
    def clamped(self) -> Tensor | int:
        """Number of clamped pixels in the last capture that this thread took, 0 before the first."""
        return getattr(self.of_thread, "clamped", 0)

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy and pickle with the warnings already given, without the captures."""
        return CaptureNotes, (tuple(self._told),)
