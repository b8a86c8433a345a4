"""Ctrl-C and SIGTERM of the command: while it imports they end the process, while it works they raise an exception.

Until this module is imported Ctrl-C shows a traceback of Python, so it imports nothing that takes time.
"""

from __future__ import annotations

import _thread
import os
import signal
import sys
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager, suppress
from types import FrameType

TYPE_CHECKING = False  # that of the module typing takes as long as all the rest
if TYPE_CHECKING:
    from typing import Any

WORDS = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated"}
PAUSE = 0.02  # seconds after which a signal in an import comes again


class Stopped(KeyboardInterrupt):
    """Ctrl-C or SIGTERM, raised so that temporary files are removed and locks released."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


def is_command() -> bool:
    """Return whether this process is ``kornia-tidy`` or ``python -m kornia_tidy``, not a program that imports us.

    Example:
        >>> is_command()
        False
    """
    if "--multiprocessing-fork" in sys.orig_argv:  # a worker, which has the arguments of its parent
        return False
    name = sys.argv[0] if getattr(sys, "argv", None) else ""
    if name == "-m":  # while Python looks for the module
        return any(argument.removeprefix("-m") == "kornia_tidy" for argument in sys.orig_argv)
    return os.path.splitext(os.path.basename(name))[0] == "kornia-tidy"


def end_on_signals() -> None:
    """Let Ctrl-C and SIGTERM end the process at once: while it imports, nothing has to be cleared up."""
    _handle(_end)


def ignore_interruption() -> None:
    """Ignore Ctrl-C in a process that ends: Python's own clearing up would show a traceback."""
    with suppress(ValueError):  # of other threads than the main one
        signal.signal(signal.SIGINT, signal.SIG_IGN)


@contextmanager
def raised_signals() -> Generator[None]:
    """Raise :class:`Stopped` on Ctrl-C and SIGTERM within a block, in the main thread and where nobody handles them.

    During an import a signal waits for its end: inside, the exception would be swallowed or told as an ``ImportError``.
    """
    outside = _imports(sys._getframe())

    def stop(number: int, frame: FrameType | None) -> None:
        if _imports(frame) > outside:
            _thread.start_new_thread(_repeat, (number, _thread.get_ident()))
            return
        if number == signal.SIGTERM:
            signal.signal(number, signal.SIG_IGN)  # a second one would interrupt the clearing up
        raise Stopped(number)

    before = _handle(stop)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def status_and_sentence(number: int) -> tuple[int, str]:
    """Return the exit status of a command that a signal ended, and its message.

    Example:
        >>> status_and_sentence(signal.SIGINT)
        (130, 'kornia-tidy: interrupted')
    """
    return 128 + number, f"kornia-tidy: {WORDS[signal.Signals(number)]}"


def _end(number: int, _: FrameType | None) -> None:
    status, sentence = status_and_sentence(number)
    with suppress(OSError):
        os.write(2, f"{sentence}\n".encode())
    os._exit(status)


def _handle(handler: Callable[[int, FrameType | None], None]) -> dict[int, Any]:
    """Set a handler for the signals that nobody handles; return those before."""
    before = {number: signal.getsignal(number) for number in WORDS}
    free = (signal.default_int_handler, signal.SIG_DFL, _end)
    found: dict[int, Any] = {number: old for number, old in before.items() if old in free}
    try:
        for number in found:
            signal.signal(number, handler)
    except ValueError:  # in another thread than the main one
        return {}
    return found


def _imports(frame: FrameType | None) -> int:
    """Return how many imports are going on in a frame and its callers."""
    count = 0
    while frame is not None:
        count += frame.f_code.co_filename == "<frozen importlib._bootstrap>"
        frame = frame.f_back
    return count


def _repeat(number: int, thread: int) -> None:
    time.sleep(PAUSE)
    if hasattr(signal, "pthread_kill"):
        signal.pthread_kill(thread, number)  # which also wakes it
    else:
        signal.raise_signal(number)
