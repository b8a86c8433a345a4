"""One command in a fork of this process, under limits of time and memory, and whether it behaved."""

from __future__ import annotations

import json
import os
import re
import resource
import shutil
import signal
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from safetensors import safe_open

from kornia_tidy.cli import command_line
from tests.mutations.pristine import Case

SECONDS = 60.0
MEMORY = 3 << 29  # bytes of address space beyond that of this process
REFUSED, GUARDED = 2, 70
UNFORESEEN = "unforeseen"  # a file that names the kind of an error
LONGEST = 1000  # characters of a sentence
WARNING, ERROR = re.compile(r"kornia-tidy: warning: \S.*"), re.compile(r"kornia-tidy: error: \S.*")


@dataclass(frozen=True)
class Outcome:
    """What became of a command."""

    status: int | None
    """Its exit status; of one that was killed, minus the signal; None if it took too long."""
    told: str
    """What it printed as errors."""
    faults: tuple[str, ...]
    """What it should not have done."""
    seconds: float

    @property
    def name(self) -> str:
        """Under which it is counted."""
        if self.status == GUARDED:
            return "guard"
        return "failed" if self.faults else "accepted" if self.status == 0 else "refused"


def prepare(case: Case, data: bytes, folder: Path) -> Path:
    """Put a damaged file where the command will find it; return it."""
    place = folder / "in"
    place.mkdir(parents=True)
    if case.companions is not None:
        for other in case.companions.iterdir():
            if other.name != case.source.name:
                os.symlink(other, place / other.name)
    path = place / case.source.name
    path.write_bytes(data)
    return path


def run(case: Case, path: Path, folder: Path, seconds: float = SECONDS) -> Outcome:
    """Let a fork of this process run the command on a damaged file, in a folder of its own."""
    begin = time.perf_counter()
    process = os.fork()
    if process == 0:
        _child(case, path, folder)
    status = _status(process, begin + seconds)
    told = (folder / "stderr").read_text(errors="replace") if (folder / "stderr").exists() else ""
    return Outcome(status, told, tuple(_faults(case, folder, status, told)), time.perf_counter() - begin)


def _child(case: Case, path: Path, folder: Path) -> None:
    """Run the command and leave; nothing of the test's own process is unwound."""
    code = 99
    try:
        os.setpgid(0, 0)
        os.chdir(folder)
        for number, name in ((1, "stdout"), (2, "stderr")):
            os.dup2(os.open(name, os.O_CREAT | os.O_WRONLY | os.O_TRUNC), number)
        sys.stdout, sys.stderr = os.fdopen(1, "w"), os.fdopen(2, "w", 1, errors="backslashreplace")
        size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (size + MEMORY, size + MEMORY))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        code = _command(case, path)
        sys.stdout.flush()
    except SystemExit as left:  # argparse's own
        code = left.code if isinstance(left.code, int) else 1
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        sys.stderr.flush()
        os._exit(code)


def _note_kind(told: Callable[[Exception], int]) -> Callable[[Exception], int]:
    """Record the type of each error that becomes a message; damaged content may only raise the allowed types."""

    def note(error: Exception) -> int:
        if not isinstance(error, (OSError, ValueError)) and not command_line._is_out_of_memory(error):
            Path(UNFORESEEN).write_text(type(error).__name__)
        return told(error)

    return note


def _command(case: Case, path: Path) -> int:
    command_line._told = _note_kind(command_line._told)
    if callable(case.command):
        try:
            case.command(path)
        except (OSError, ValueError) as error:
            print(f"kornia-tidy: error: {' '.join(str(error).split())}", file=sys.stderr)
            return REFUSED
        return 0
    return command_line.main(
        [str(path) if word == "IN" else str(path.parent) if word == "FOLDER" else word for word in case.command]
    )


def _status(process: int, deadline: float) -> int | None:
    while True:
        done, status = os.waitpid(process, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        if time.perf_counter() > deadline:
            os.killpg(process, signal.SIGKILL)
            os.waitpid(process, 0)
            return None
        time.sleep(0.002)


def _faults(case: Case, folder: Path, status: int | None, told: str) -> list[str]:
    """Return what a command did that it should not."""
    lines = told.splitlines()
    errors = [line for line in lines if ERROR.fullmatch(line)]
    faults = []
    if status is None:
        faults.append("hangs")
    elif status < 0:
        faults.append(f"killed by signal {-status}")
    elif status == GUARDED:
        faults.append("was not foreseen")
    elif status not in {0, REFUSED}:
        faults.append(f"exit status {status}")
    if "Traceback" in told:
        faults.append("traceback")
    elif status in {0, REFUSED}:
        if strange := [line for line in lines if not WARNING.fullmatch(line) and line not in errors]:
            faults.append(f"prints {strange[0][:100]!r}")
        if len(errors) != (status == REFUSED):
            faults.append(f"{len(errors)} sentences with exit status {status}")
        if any(len(line) > LONGEST for line in lines):
            faults.append("a sentence of more than a thousand characters")
    if (folder / UNFORESEEN).exists():
        faults.append(f"a {(folder / UNFORESEEN).read_text()} came as far as the command")
    known = {"in", UNFORESEEN, "stdout", "stderr", *case.outputs}
    faults += [f"leaves {name}" for name in sorted(os.listdir(folder)) if name not in known]
    for name in case.outputs:
        faults += _half_written(folder / name, status)
    return faults


def _half_written(path: Path, status: int | None) -> list[str]:
    if not path.exists():
        return [f"{path.name} is missing"] if status == 0 else []
    if path.is_dir():
        files = [p for p in path.rglob("*") if p.is_file()]
        return [f"{p.name} is not whole" for p in files if not _whole(p)]
    if status != 0:
        return [f"{path.name} is there with exit status {status}"]
    return [] if _whole(path) else [f"{path.name} is not whole"]


def _whole(path: Path) -> bool:
    try:
        if path.suffix in {".png", ".jpg", ".tif"}:
            return cv2.imread(str(path), cv2.IMREAD_UNCHANGED) is not None
        if path.suffix == ".npy":
            return bool(np.load(path).size)
        if path.suffix == ".safetensors":
            with safe_open(path, framework="pt") as file:
                return bool(file.keys())
        if path.suffix == ".json":
            return json.loads(path.read_bytes()) is not None
    except Exception:
        return False
    return path.suffix == ".csv"


def clear(folder: Path) -> None:
    shutil.rmtree(folder, ignore_errors=True)


def shown(argv: Sequence[str] | object) -> str:
    return " ".join(argv) if isinstance(argv, tuple) else getattr(argv, "__qualname__", str(argv))
