"""Forks of the test process under limits of memory, file size and rights; their exit status and what they said."""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from kornia_tidy import cli
from tests.forks import fork, wait

NOBODY = 65534


class Outcome(NamedTuple):
    """What became of a command."""

    status: int
    told: str
    """Standard error."""
    printed: str


def limit_memory(more: int) -> None:
    """Let this process take no more than so many bytes of address space beyond what it has."""
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + more, size + more))


def limit_files(size: int) -> None:
    """Let this process write no file larger than so many bytes, as on a full disk."""
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))


def drop_rights() -> None:
    """Go on as a user who owns nothing; the superuser may write into read-only folders."""
    if os.getuid() == 0:
        os.setgid(NOBODY)
        os.setuid(NOBODY)


def command(argv: Sequence[str], folder: Path, before: Callable[[], object] = bool) -> Outcome:
    """Run a command in a fork of this process that works in a folder."""
    outputs = [folder.parent / f"{folder.name}.{name}" for name in ("stdout", "stderr")]

    def child() -> None:
        os.chdir(folder)
        for number, path in enumerate(outputs, 1):
            os.dup2(os.open(path, os.O_CREAT | os.O_WRONLY | os.O_TRUNC, 0o666), number)
        sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w", 1, errors="backslashreplace")
        before()
        status = cli.main(argv)
        sys.stdout.flush()
        os._exit(status)

    status = wait(fork(child))
    printed, told = (path.read_text(errors="replace") for path in outputs)
    return Outcome(status, told, printed)


def apart(function: Callable[..., Any], *arguments: object) -> Any:
    """Call a function of a test module in a new process, with arguments and a result that JSON holds.

    Gradients are refused in forks of a process that computed some, as one of pytest may have done before.
    """
    name, module = function.__name__, function.__module__
    script = (
        f"import json, sys, torch; from {module} import {name}; torch.set_num_threads(1); "
        f"print(json.dumps({name}(*json.loads(sys.argv[1]))))"
    )
    run = [sys.executable, "-c", script, json.dumps(arguments)]
    done = subprocess.run(run, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])
