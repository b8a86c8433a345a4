"""Capture of messages that image libraries print to stderr from C, beyond the reach of Python's warning filters."""

from __future__ import annotations

import os
import re
import threading
from collections.abc import Generator
from contextlib import contextmanager

_LIBRARIES = re.compile(
    r"libpng |Corrupt JPEG |Premature end of JPEG |Inconsistent progression |Invalid SOS |Unknown Adobe color |"
    r"Warning: unknown JFIF |Application transferred |\[ ?(?:WARN|ERROR|INFO):|"
    r"<python_buffer>: "  # OpenEXR
)
_ERROR = 2  # the process's stderr
_PIPE_HOLDS = 1 << 16


class _Catch:
    """Lock for the redirection of the process's stderr; a process forked meanwhile gets stderr back and a new lock."""

    def __init__(self) -> None:
        self.lock, self.saved = threading.Lock(), None
        if hasattr(os, "register_at_fork"):
            os.register_at_fork(after_in_child=self._in_child)

    def _in_child(self) -> None:
        self.lock = threading.Lock()
        if self.saved is not None:
            os.dup2(self.saved, _ERROR)

    saved: int | None


_catch = _Catch()


@contextmanager
def caught() -> Generator[list[str]]:
    """Yield a list that holds, after the block, the lines that image libraries printed to stderr in it.

    All other lines, such as those of another thread, are printed after the block.

    Example:
        >>> with caught() as said:
        ...     _ = os.write(2, b"libpng warning: gamma value is odd")
        >>> said
        ['libpng warning: gamma value is odd']
    """
    said: list[str] = []
    with _catch.lock:
        try:
            saved = os.dup(_ERROR)
        except OSError:  # stderr is closed
            yield said
            return
        _catch.saved = saved
        read, write = os.pipe()
        try:
            os.set_blocking(write, False)  # a writer does not wait when the pipe is full
            os.dup2(write, _ERROR)
            yield said
        finally:
            os.dup2(saved, _ERROR)
            _catch.saved = None
            os.close(write)
            os.set_blocking(read, False)
            text = _all(read)
            os.close(read)
            os.close(saved)
            lines = text.decode(errors="replace").splitlines(keepends=True)
            said += [line.rstrip() for line in lines if _LIBRARIES.match(line)]
            if others := "".join(line for line in lines if not _LIBRARIES.match(line)):
                os.write(_ERROR, others.encode())


def _all(pipe: int) -> bytes:
    """Return the contents of a pipe, without waiting for its end: a forked process may hold the other end."""
    parts = []
    try:
        while part := os.read(pipe, _PIPE_HOLDS):
            parts.append(part)
    except BlockingIOError:
        pass
    return b"".join(parts)
