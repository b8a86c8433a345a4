"""Thread safety of shared cameras: a lock that survives copies, pickles and forks, and notes of each thread."""

from __future__ import annotations

import os
import threading
from collections.abc import Hashable, Iterable
from typing import Any, Self

from torch import Tensor


class SharedLock:
    """A re-entrant lock for objects that are copied, pickled and carried into forked processes.

    A copy has a new lock. So has a forked child, since the thread that held the lock does not exist there.

    Example:
        >>> import copy
        >>> lock = SharedLock()
        >>> with lock, copy.deepcopy(lock), lock:
        ...     pass
    """

    def __init__(self) -> None:
        self._lock, self._process = threading.RLock(), os.getpid()

    def __enter__(self) -> Self:
        if self._process != os.getpid():
            self._lock, self._process = threading.RLock(), os.getpid()
        self._lock.acquire()
        return self

    def __exit__(self, *raised: object) -> None:
        self._lock.release()

    def __reduce__(self) -> tuple[type[SharedLock], tuple[()]]:
        """Copy and pickle as a new, open lock."""
        return SharedLock, ()


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
        self._of_thread = threading.local()

    def first_time(self, warning: Hashable) -> bool:
        """Return True the first time that a warning is requested, in any thread."""
        mine = object()
        return self._told.setdefault(warning, mine) is mine  # atomic in the interpreter

    def is_told(self, warning: Hashable) -> bool:
        """Return whether a warning was given."""
        return warning in self._told

    @property
    def clamped(self) -> Tensor | None:
        """Number of clamped pixels in the last capture that this thread took, None before the first."""
        return getattr(self._of_thread, "clamped", None)

    @clamped.setter
    def clamped(self, count: Tensor | None) -> None:
        self._of_thread.clamped = count

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy and pickle with the warnings already given, without the captures."""
        return CaptureNotes, (tuple(self._told),)
