"""What image libraries print to stderr from C, where no warning filter reaches it: caught, for the caller to judge."""

from __future__ import annotations

import os
import re
import threading
from collections.abc import Generator
from contextlib import contextmanager

_LIBRARIES = re.compile(
    r"libpng |Corrupt JPEG |Premature end of JPEG |Inconsistent progression |Invalid SOS |Unknown Adobe color |"
    r"Warning: unknown JFIF |Application transferred |\[ ?(?:WARN|ERROR|INFO):|TIFF\w*: |\S+: Warning, "
)
_ERROR = 2  # the process's stderr
_PIPE_HOLDS = 1 << 16


class _Catch:
    """One at a time: stderr belongs to the process. A fork in the meantime gets its stderr and a lock of its own."""

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
    """Give a list that holds, after the block, the lines that image libraries printed in it to stderr.

    Lines of others, such as another thread's, are printed when the block has ended.

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
        except OSError:  # closed: nobody can print there
            yield said
            return
        _catch.saved = saved
        read, write = os.pipe()
        try:
            os.set_blocking(write, False)  # who prints more than a pipe holds need not wait for us
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
    """What a pipe holds; another process that was forked meanwhile may still have its other end."""
    parts = []
    try:
        while part := os.read(pipe, _PIPE_HOLDS):
            parts.append(part)
    except BlockingIOError:
        pass
    return b"".join(parts)
