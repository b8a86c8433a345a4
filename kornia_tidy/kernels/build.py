"""C sources of this package, compiled for the processor they run on when they are first wanted.

Wheels would have to be built for every system and would know only its oldest processors. Most machines that run PyTorch
have a C compiler (``torch.compile`` asks for one too), so the source is compiled once, in a second or two, and kept in
the user's cache. Without a compiler nothing is lost but speed: whoever asks gets None and takes another way, and one
warning says why and what it costs.

A library is loaded only if it is whole and the user's own: its name holds a digest of its content, and nobody else may
own it or write to it. A library that fails this is built again.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import re
import shlex
import shutil
import signal
import stat
import subprocess
import tempfile
import warnings
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import torch

REALS = {torch.float32: "float", torch.float64: "double"}
KERNELS = Path(__file__).parent  # the folder of the C sources
SHARED = KERNELS / "vectors.h"  # what sources include
FLAGS = ("-O3", "-std=gnu11", "-ffp-contract=fast", "-fPIC", "-shared", f"-I{SHARED.parent}")
NATIVE = {"x86_64": "-march=native", "AMD64": "-march=native"}
THREADS = "-fopenmp"  # PyTorch has brought OpenMP's library along, but a compiler may lack its own
SECONDS = 120  # to wait for a compiler, which needs two to seven on an idle processor
COST = "takes 2 to 6 times as long"  # captures: 3.3 (gather) and 5.6 (occlusion) on Zen 4, 2.0 and 3.2 on Zen 1

_hung: list[str] = []  # the reason, once a compiler was ended: no compiler is called again
_warned: set[bool] = set()  # of a library that is missing (False), of one without threads (True)


class CompiledCodeWarning(RuntimeWarning):
    """Rendering is slower than it could be on this machine, since compiled code cannot be used."""


class NotBuiltError(RuntimeError):
    """Why there is no library, in words."""


@dataclass(frozen=True)
class Compiler:
    """A C compiler as it is called.

    Args:
        program: the words that start it, such as ``("ccache", "gcc")``.
        options: what the user wants it to be told, after everything else.
        version: the first line of what it says of itself.
    """

    program: tuple[str, ...]
    options: tuple[str, ...]
    version: str


@dataclass(frozen=True)
class Build:
    """What became of a C source.

    Args:
        library: to call functions of; None if there is none.
        path: where the library lies.
        threads: whether it shares its work among threads.
        remark: why there is no library, or why it has one thread only.
    """

    library: ctypes.CDLL | None
    path: Path | None = None
    threads: bool = False
    remark: str = ""


@cache
def compiled(source: Path, dtype: torch.dtype) -> ctypes.CDLL | None:
    """Return a C source as a library in which ``REAL`` is the given type, or None where it cannot be had.

    The library is kept under ``$XDG_CACHE_HOME/kornia_tidy`` (``~/.cache/kornia_tidy``, or a private temporary folder
    where that cannot be written to), named after all that it depends on: source, width of its vectors in bytes,
    compiler with its version, flags and processor. ``$CC`` chooses the compiler, with its own options if need be
    (``CC="ccache gcc -pthread"``).

    Args:
        source: a file of C.
        dtype: ``torch.float32`` or ``torch.float64``.

    Warns:
        CompiledCodeWarning: the first time that there is no library, or one without threads, with the reason.

    Example:
        >>> import pytest
        >>> with pytest.warns(CompiledCodeWarning, match="no such file"):
        ...     compiled(Path("/does/not/exist.c"), torch.float32) is None
        True
    """
    built = build(source, dtype)
    there = built.library is not None
    if not (there and built.threads) and there not in _warned:
        _warned.add(there)
        lost = "compiled code runs in one thread" if there else f"compiled code is not used, which {COST}"
        warnings.warn(f"{lost}: {built.remark} (see `kornia-tidy info`)", CompiledCodeWarning, stacklevel=3)
    return built.library


def load(source: Path, dtype: torch.dtype) -> ctypes.CDLL:
    """Return a C source as a library, see :func:`compiled`, or raise an error with the reason for its absence.

    Raises:
        NotBuiltError: if there is no library.
    """
    library = compiled(source, dtype)
    if library is None:
        raise NotBuiltError(f"{source.name} is not compiled: {build(source, dtype).remark}")
    return library


def vector_bytes(library: ctypes.CDLL) -> int:
    """Return the width in bytes of the vectors that a library of this package computes with, see ``vectors.h``."""
    return ctypes.c_int64.in_dll(library, "vector_bytes").value


@cache
def build(source: Path, dtype: torch.dtype) -> Build:
    """Build a C source and report the library's path or the reason for its absence, without a warning."""
    try:
        return _build(source, dtype, find_compiler(), cache_folder())
    except NotBuiltError as error:
        return Build(None, remark=str(error))
    except OSError as error:
        return Build(None, remark=f"{source.name}: {error.strerror or error}")


def _build(source: Path, dtype: torch.dtype, compiler: Compiler, folder: Path) -> Build:
    if not source.is_file():
        raise NotBuiltError(f"{source}: no such file")
    remark = ""
    for extra in ((THREADS,), ()):
        flags = (*FLAGS, NATIVE.get(platform.machine(), "-mcpu=native"), *extra, f"-DREAL={REALS[dtype]}")
        name = f"{source.stem}-{target_vector_bytes(compiler)}-{_digest(source, compiler, flags)}"
        path = _find(folder, name)
        if path is None:
            if extra and (why := _no_threads(compiler)):
                remark = why
                continue
            path = _compile(source, folder, name, [*compiler.program, *flags, *compiler.options])
        try:
            return Build(ctypes.CDLL(str(path)), path, bool(extra), remark)
        except OSError as error:  # such as OpenMP's library, which may be missing when it is wanted
            remark = f"{path.name} cannot be loaded: {error}"
    raise NotBuiltError(remark)


# ---------------------------------------------------------------------- the compiler


@cache
def find_compiler() -> Compiler:
    """Return the compiler that ``$CC`` names, or the first of cc, gcc and clang on the path.

    Raises:
        NotBuiltError: if there is none, or it does not even tell its version.
    """
    words = _words(os.environ.get("CC", ""))
    if not words:
        found = next(filter(None, map(shutil.which, ("cc", "gcc", "clang"))), None)
        if found is None:
            raise NotBuiltError("no C compiler was found: install gcc or clang, or name one in $CC")
        words = [found]
    first_option = next((i for i, word in enumerate(words) if i and word.startswith("-")), len(words))
    program, options = tuple(words[:first_option]), tuple(words[first_option:])
    version = _run([*program, "--version"]).strip().splitlines()
    return Compiler(program, options, version[0] if version else "a compiler that tells no version")


@cache
def target_vector_bytes(compiler: Compiler) -> int:
    """Return the width in bytes of the vectors that ``vectors.h`` makes of a compiler's target; 0 if it is not told.

    The compiler is asked, as wrappers, environment and configuration files change what it targets, not options alone.
    """
    native = NATIVE.get(platform.machine(), "-mcpu=native")
    macros = _run([*compiler.program, *FLAGS, native, *compiler.options, "-E", "-dM", str(SHARED)])
    found = re.search(r"^#define VECTOR_BYTES (\d+)$", macros, re.MULTILINE)
    return int(found[1]) if found else 0


def _words(command: str) -> list[str]:
    """Split a command into words; one that is a file as it stands may have spaces in its name."""
    if shutil.which(command):
        return [command]
    try:
        return shlex.split(command)
    except ValueError as error:
        raise NotBuiltError(f"$CC is {command!r}, which is no command: {error}") from None


@cache
def _no_threads(compiler: Compiler) -> str:
    """Return why a compiler cannot build for threads, which may lack OpenMP's library; empty if it can."""
    with tempfile.TemporaryDirectory() as folder:
        source = Path(folder) / "threads.c"
        source.write_text("#include <omp.h>\nint threads(void) { return omp_get_max_threads(); }\n")
        command = [*compiler.program, "-fPIC", "-shared", THREADS, "-o", str(source.with_suffix(".so")), str(source)]
        try:
            _run([*command, *compiler.options])
        except NotBuiltError as error:
            return f"{compiler.version} cannot build for threads, install its OpenMP library ({error})"
    return ""


def _run(command: list[str]) -> str:
    """Run a compiler and return what it prints. One that hangs is ended with all that it has started.

    Raises:
        NotBuiltError: if it says no, hangs, or is not there.
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


def _compile(source: Path, folder: Path, name: str, command: list[str]) -> Path:
    """Compile and install a library in one step, under a name with the digests of its inputs and of its content."""
    with tempfile.TemporaryDirectory(dir=folder) as own:
        new = Path(own) / "library.so"
        _run([*command, "-o", str(new), str(source)])
        new.chmod(0o700)
        with new.open("rb") as file:
            os.fsync(file.fileno())
        path = folder / f"{name}-{_content_digest(new)}.so"
        new.replace(path)
    with suppress(OSError):  # not every system has folders that can be synchronised
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    return path


# ---------------------------------------------------------------------- the cache


@cache
def cache_folder() -> Path:
    """Return the folder of compiled libraries, which no one else may write to.

    Raises:
        OSError: if there is none that can be used.
    """
    try:
        home = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        return _private(home / "kornia_tidy")
    except (OSError, RuntimeError):  # the second: a user without a home folder
        user = f"-{os.getuid()}" if hasattr(os, "getuid") else ""
        return _private(Path(tempfile.gettempdir()) / f"kornia_tidy{user}")


def _private(folder: Path) -> Path:
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    status = folder.lstat() if folder.parent == Path(tempfile.gettempdir()) else folder.stat()
    if not (stat.S_ISDIR(status.st_mode) and is_ours(status) and os.access(folder, os.W_OK | os.X_OK)):
        raise PermissionError(f"{folder} must belong to the user and be writable for no one else")
    return folder


def is_ours(status: os.stat_result) -> bool:
    """Whether something belongs to this user, and only this user may write to it."""
    return not hasattr(os, "getuid") or (status.st_uid == os.getuid() and not status.st_mode & 0o022)


def _find(folder: Path, name: str) -> Path | None:
    """Return the library of a name that is whole and ours. What is not is removed, so that it is built again."""
    for path in sorted(folder.glob(f"{name}-*.so")):
        status = path.lstat()
        whole = stat.S_ISREG(status.st_mode) and path.stem == f"{name}-{_content_digest(path)}"
        if whole and is_ours(status):
            return path
        with suppress(OSError):
            path.unlink()
    return None


def _content_digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:32]


def _digest(source: Path, compiler: Compiler, flags: tuple[str, ...]) -> str:
    """Name all that a library depends on in 16 digits. One source may include others of its folder."""
    sources = [SHARED, *sorted(source.parent.glob("*.c"))]
    words = [source.name, *compiler.program, compiler.version, *flags, *compiler.options]
    parts = [*(path.read_bytes() for path in sources), *(word.encode() for word in words), processor_features()]
    return hashlib.sha256(b"\0".join(parts)).hexdigest()[:16]


@cache
def processor_features() -> bytes:
    """Return the processor's model and instruction sets: unlike machines may share a home folder."""
    try:
        lines = Path("/proc/cpuinfo").read_bytes().split(b"\n\n")[0].splitlines()
    except OSError:
        return f"{platform.machine()} {platform.processor()}".encode()
    kept = (b"model name", b"flags", b"Features", b"CPU part")
    return b"\n".join(line for line in lines if line.startswith(kept))
