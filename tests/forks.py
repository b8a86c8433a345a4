"""Forks of the test process for tests that kill a process; a fork needs no new imports."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable


def fork(child: Callable[[], object]) -> int:
    """Run a function in a fork, in a group of its own; return the process's number."""
    process = os.fork()
    if process == 0:
        code = 1
        try:
            os.setpgid(0, 0)
            child()
            code = 0
        except BaseException as error:
            print(f"{type(error).__name__}: {error}", file=sys.stderr, flush=True)
        finally:
            os._exit(code)
    return process


def wait(process: int) -> int:
    """Return the exit code of a fork once it has ended; of one that was killed, minus the signal."""
    return os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
