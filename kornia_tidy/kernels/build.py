"""C sources of this package as libraries: from a wheel, or compiled here on first use.

A wheel that ``make wheel`` makes holds them for each level of processors of its platform, and the best one that this
processor can run is loaded: no compiler is needed. Otherwise, and where ``$CC`` names a compiler, the source is
compiled for this very processor, in seconds, and kept in the user's cache. Each way stands in where the other fails.
If both do, only speed is lost: the caller gets None and computes in torch, and one warning gives the reason and the
cost.

A wheel's libraries are trusted as the package's Python code beside them is. A library of the cache is loaded only if it
is whole and the user's own: its name holds a digest of its content, and nobody else may own it or write to it. One that
fails this is built again, and so is one that another process removes meanwhile.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import re
import stat
import tempfile
import warnings
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import torch

from kornia_tidy.kernels.compiler import (
    THREADS,
    Compiler,
    NotBuiltError,
    find_compiler,
    named_compiler,
    run,
    why_no_threads,
)
from kornia_tidy.kernels.processor import levels_here, processor_features

REALS = {torch.float32: "float", torch.float64: "double"}
KERNELS = Path(__file__).parent  # the folder of the C sources
SHARED = KERNELS / "vectors.h"  # what sources include
FLAGS = ("-O3", "-std=gnu11", "-ffp-contract=fast", "-fno-math-errno", "-fPIC", "-shared", f"-I{SHARED.parent}")
NATIVE = {"x86_64": "-march=native", "AMD64": "-march=native"}
LIBRARIES = "libraries"  # the folder beside the sources that a wheel has
NO_LIBRARIES = "the wheel that `make wheel` makes in a checkout needs no compiler"
COST = "takes 2 to 6 times as long"  # captures: 3.3 (gather) and 5.6 (occlusion) on Zen 4, 2.0 and 3.2 on Zen 1

_warned: set[bool] = set()  # of a library that is missing (False), of one without threads (True)


class CompiledCodeWarning(RuntimeWarning):
    """Rendering is slower than it could be on this machine, since compiled code cannot be used."""


@dataclass(frozen=True)
class Build:
    """What became of a C source.

    Args:
        library: with the functions; None without one.
        path: where the library lies.
        origin: where it comes from, in words: from the wheel, or compiled here.
        threads: whether it shares its work among threads.
        remark: reason why the library is missing, has only one thread, or comes from the second choice.
    """

    library: ctypes.CDLL | None
    path: Path | None = None
    origin: str = ""
    threads: bool = False
    remark: str = ""


@cache
def compiled(source: Path, dtype: torch.dtype) -> ctypes.CDLL | None:
    """Return a C source as a library in which ``REAL`` is the given type, or None where it cannot be had.

    A library of the wheel is taken if there is one for this processor. Else the source is compiled, and kept under
    ``$XDG_CACHE_HOME/kornia_tidy`` (``~/.cache/kornia_tidy``, or a private temporary folder where that cannot be
    written to), named after all that it depends on: source, width of the vectors in bytes, compiler with its version,
    flags and processor. ``$CC`` chooses the compiler, with its own options if need be (``CC="ccache gcc -pthread"``),
    and is preferred to the wheel.

    Args:
        source: a file of C.
        dtype: ``torch.float32`` or ``torch.float64``.

    Warns:
        CompiledCodeWarning: the first time that the library is missing or has no threads, with the reason.

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
        NotBuiltError: if the library is missing.
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
    """Load or build a C source and report the library's path or the reason for its absence, without a warning."""
    if not source.is_file():
        return Build(None, remark=f"{source}: no such file")
    ways = (_from_compiler, _from_wheel) if named_compiler() else (_from_wheel, _from_compiler)
    reasons = []
    for way in ways:
        try:
            built = way(source.absolute(), dtype)
        except NotBuiltError as error:
            reasons.append(str(error))
        except OSError as error:
            reasons.append(f"{source.name}: {error.strerror or error}")
        else:
            return replace(built, remark=_joined([*reasons, built.remark]))
    return Build(None, remark=_joined([*reasons, "" if (source.parent / LIBRARIES).is_dir() else NO_LIBRARIES]))


def _joined(reasons: list[str]) -> str:
    return "; ".join(filter(None, reasons))


# ---------------------------------------------------------------------- the wheel


def library_name(source: Path, dtype: torch.dtype, level: str) -> str:
    """Return the name of a library in a wheel."""
    return f"{source.stem}-{REALS[dtype]}-{level}.so"


def _level(folder: Path) -> str | None:
    """Return the best level that a wheel's libraries are for and that this processor can run."""
    return next((level for level in levels_here() if any(folder.glob(f"*-{level}.so"))), None)


def _from_wheel(source: Path, dtype: torch.dtype) -> Build:
    folder = source.parent / LIBRARIES
    level = _level(folder)
    if level is None:
        raise NotBuiltError("the wheel's libraries need a newer processor" if folder.is_dir() else "")
    path = folder / library_name(source, dtype, level)
    return Build(_load_beside_torch(path), path, f"from the wheel, for {level}", threads=True)


def _load_beside_torch(path: Path) -> ctypes.CDLL:
    """Load a library that takes OpenMP from torch, and shares its threads.

    torch opens it for all libraries of the process, by a name that differs from version to version.
    """
    try:
        return ctypes.CDLL(str(path))
    except OSError:  # a torch that has opened it for itself, or none
        ctypes.CDLL("libgomp.so.1", mode=ctypes.RTLD_GLOBAL)
        return ctypes.CDLL(str(path))


# ---------------------------------------------------------------------- compiled here


def _from_compiler(source: Path, dtype: torch.dtype) -> Build:
    """Load the library that the cache has, or compile it for this very processor."""
    compiler = find_compiler()
    origin, remark = f"compiled for this processor by {compiler.version}", ""
    for extra in ((THREADS,), ()):
        flags = (*FLAGS, NATIVE.get(platform.machine(), "-mcpu=native"), *extra, f"-DREAL={REALS[dtype]}")
        name = f"{source.stem}-{target_vector_bytes(compiler)}-{_digest(source, compiler, flags)}"
        try:
            path, library = _cached(source, name, [*compiler.program, *flags, *compiler.options])
        except NotBuiltError:
            remark = why_no_threads(compiler) if extra else ""
            if not remark:
                raise
        except OSError as error:  # such as OpenMP's library, which may be missing when it is wanted
            remark = f"{source.name}: {error.strerror or error}"
        else:
            return Build(library, path, origin, bool(extra), remark)
    raise NotBuiltError(remark)


def _cached(source: Path, name: str, command: list[str]) -> tuple[Path, ctypes.CDLL]:
    """Return a library of the cache and its path, compiled if need be.

    Another process may remove a file or the whole cache at any moment, so that it is tried three times.
    """

    def library() -> tuple[Path, ctypes.CDLL]:
        folder = cache_folder()
        path = _find(folder, name) or _compile(source, folder, name, command)
        return path, ctypes.CDLL(str(path))

    for _ in range(2):
        with suppress(OSError):
            return library()
    return library()


@cache
def target_vector_bytes(compiler: Compiler) -> int:
    """Return the width in bytes of the vectors of ``vectors.h`` for a compiler's target; 0 if unknown.

    The compiler itself is asked, since wrappers, environment and configuration files also change its target.
    """
    native = NATIVE.get(platform.machine(), "-mcpu=native")
    macros = run([*compiler.program, *FLAGS, native, *compiler.options, "-E", "-dM", str(SHARED)])
    found = re.search(r"^#define VECTOR_BYTES (\d+)$", macros, re.MULTILINE)
    return int(found[1]) if found else 0


def _compile(source: Path, folder: Path, name: str, command: list[str]) -> Path:
    """Compile and install a library in one step, under a name with the digests of its inputs and of its content.

    One that a crash of the system leaves incomplete does not match its name, and is built again.
    """
    with tempfile.TemporaryDirectory(dir=folder) as own:
        new = Path(own) / "library.so"
        try:
            run([*command, "-o", str(new), str(source)])
        except NotBuiltError as error:
            if Path(own).is_dir():
                raise
            raise FileNotFoundError(f"the cache was removed while it was compiled: {error}") from None
        new.chmod(0o700)
        path = folder / f"{name}-{_content_digest(new)}.so"
        new.replace(path)
    return path


# ---------------------------------------------------------------------- the cache


def cache_folder() -> Path:
    """Return the folder of compiled libraries, which no one else may write to. It is made if it is not there.

    Source: XDG Base Directory Specification, which ignores a relative ``$XDG_CACHE_HOME``.

    Raises:
        OSError: if no folder can be used.
    """
    try:
        named = os.environ.get("XDG_CACHE_HOME", "")
        home = Path(named) if os.path.isabs(named) else Path.home() / ".cache"
        if not home.is_absolute():
            raise RuntimeError("a relative home folder is that of whatever folder one is in")
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
    """Return the library of a name that is whole and ours. Invalid files are removed and built again."""
    paths: list[Path] = []
    with suppress(OSError):
        paths = sorted(folder.glob(f"{name}-*.so"))
    for path in paths:
        with suppress(OSError):  # another process may remove it at any moment
            status = path.lstat()
            whole = stat.S_ISREG(status.st_mode) and path.stem == f"{name}-{_content_digest(path)}"
            if whole and is_ours(status):
                return path
            path.unlink()
    return None


def _content_digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:32]


def _digest(source: Path, compiler: Compiler, flags: tuple[str, ...]) -> str:
    """Name all that a library depends on in 16 digits. One source may include others of its folder."""
    sources = [*sorted(source.parent.glob("*.h")), *sorted(source.parent.glob("*.c"))]
    words = [source.name, *compiler.program, compiler.version, *flags, *compiler.options]
    parts = [*(path.read_bytes() for path in sources), *(word.encode() for word in words), processor_features()]
    return hashlib.sha256(b"\0".join(parts)).hexdigest()[:16]
