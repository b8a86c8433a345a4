"""What threads need that share one camera: a lock that copies, pickles and forks find open, and notes for each."""

from __future__ import annotations

import os
import threading
from collections.abc import Hashable, Iterable
from typing import Any, Self

from torch import Tensor


class SharedLock:
    """A re-entrant lock for objects that are copied, pickled and carried into forked processes.

    A copy has a lock of its own. So has a forked child, in which the thread that held the lock does not exist.

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
        """Return how a copy is made: as a new lock."""
        return SharedLock, ()


class CaptureNotes:
    """What a camera notes about its captures: the clamped pixels of each thread's last one, and which warnings it gave.

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
        """Return whether nobody asked for this warning before, in any thread."""
        mine = object()
        return self._told.setdefault(warning, mine) is mine  # one step of the interpreter

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
        """Return how a copy is made: it knows which warnings were given, and no capture."""
        return CaptureNotes, (tuple(self._told),)
