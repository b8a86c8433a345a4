"""The user's C compiler: found once, called with a time limit, and told to use the processor's instructions."""

from __future__ import annotations

import os
import shlex
import signal
import subprocess
import tempfile
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from kornia_tidy.search_path import ROOT, find_program

THREADS = "-fopenmp"  # PyTorch has brought OpenMP's library along, but a compiler may lack its own
SECONDS = 120  # to wait for a compiler, which needs two to seven on an idle processor

_hung: list[str] = []  # the reason, once a compiler was ended: no compiler is called again


class NotBuiltError(RuntimeError):
    """Reason why the library is missing, in words."""


@dataclass(frozen=True)
class Compiler:
    """The call of a C compiler.

    Args:
        program: the words that start it, such as ``("ccache", "gcc")``.
        options: the user's options, after all others.
        version: the first line of its own description.
    """

    program: tuple[str, ...]
    options: tuple[str, ...]
    version: str


@cache
def find_compiler() -> Compiler:
    """Return the compiler that ``$CC`` names, or the first of cc, gcc and clang on the path.

    Raises:
        NotBuiltError: if no compiler is found, or it does not print its version.
    """
    words = _words(named_compiler())
    if not words:
        found = next(filter(None, map(_program, ("cc", "gcc", "clang"))), "")
        if not found:
            raise NotBuiltError("no C compiler was found: install gcc or clang, or name one in $CC")
        words = [found]
    words[0] = _program(words[0]) or words[0]
    if not os.path.isabs(words[0]):
        raise NotBuiltError(f"the C compiler {words[0]} of $CC is in no absolute folder of $PATH; give its whole path")
    first_option = next((i for i, word in enumerate(words) if i and word.startswith("-")), len(words))
    program, options = tuple(words[:first_option]), tuple(words[first_option:])
    version = run([*program, "--version"]).strip().splitlines()
    return Compiler(program, options, version[0] if version else "a compiler that tells no version")


def named_compiler() -> str:
    """Return the command in ``$CC``, empty if it is not set."""
    return os.environ.get("CC", "").strip()


def _words(command: str) -> list[str]:
    """Split a command into words; a command that is the name of a file may contain spaces."""
    if _program(command):
        return [command]
    try:
        return shlex.split(command)
    except ValueError as error:
        raise NotBuiltError(f"$CC is {command!r}, which is no command: {error}") from None


def _program(name: str) -> str:
    """Return the path of a program that does not depend on the current folder, empty if it is not found."""
    try:
        return find_program(name)
    except FileNotFoundError:
        return ""


@cache
def why_no_threads(compiler: Compiler) -> str:
    """Return why a compiler cannot build for threads, which may lack OpenMP's library; empty if it can."""
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "threads.c"
        source.write_text("#include <omp.h>\nint threads(void) { return omp_get_max_threads(); }\n")
        command = [*compiler.program, "-fPIC", "-shared", THREADS, "-o", str(source.with_suffix(".so")), str(source)]
        try:
            run([*command, *compiler.options])
        except NotBuiltError as error:
            return f"{compiler.version} cannot build for threads, install its OpenMP library ({error})"
    return ""


def run(command: list[str]) -> str:
    """Run a compiler and return its output. One that hangs is ended with all that it has started.

    Raises:
        NotBuiltError: if it fails, hangs, or is missing.
    """
    if _hung:
        raise NotBuiltError(_hung[0])
    name = Path(command[0]).name
    try:
        process = subprocess.Popen(  # noqa: S603 (the user's own compiler)
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            errors="replace",
            start_new_session=True,
            # Its own calls are not looked up in the current folder either.
            cwd=ROOT,
            env={**os.environ, "PATH": os.pathsep.join(filter(os.path.isabs, os.get_exec_path()))},
        )
    except OSError as error:
        raise NotBuiltError(f"the C compiler {command[0]} cannot be started: {error.strerror}") from None
    try:
        output, complaints = process.communicate(timeout=SECONDS)
    except subprocess.TimeoutExpired:
        _end(process)
        _hung.append(f"the C compiler {name} was ended, since it took more than {SECONDS} s")
        raise NotBuiltError(_hung[0]) from None
    except BaseException:
        _end(process)
        raise
    if process.returncode:
        said = next((line for line in complaints.splitlines() if "error" in line), complaints.strip()[-300:])
        raise NotBuiltError(f"the C compiler {name} failed (status {process.returncode}): {said.strip() or 'no word'}")
    return output


def _end(process: subprocess.Popen[str]) -> None:
    if hasattr(os, "killpg"):
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    process.kill()
    process.communicate()
