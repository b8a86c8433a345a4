"""C sources of this package, compiled for the processor they run on when they are first wanted.

Wheels would have to be built for every system and would know only its oldest processors. Most machines that run PyTorch
have a C compiler (``torch.compile`` asks for one too), so the source is compiled once, in a second or two, and kept in
the user's cache. Without a compiler nothing is lost but speed: whoever asks gets None and takes another way.
"""

from __future__ import annotations

import ctypes
import hashlib
import logging
import os
import platform
import shlex
import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path

import torch

REALS = {torch.float32: "float", torch.float64: "double"}
SHARED = Path(__file__).with_name("vectors.h")  # what sources include
FLAGS = ("-O3", "-std=gnu11", "-ffp-contract=fast", "-fPIC", "-shared", f"-I{SHARED.parent}")
NATIVE = {"x86_64": "-march=native", "AMD64": "-march=native"}
SECONDS = 120  # to wait for a compiler

_log = logging.getLogger(__name__)


@cache
def compiled(source: Path, dtype: torch.dtype) -> ctypes.CDLL | None:
    """Return a C source as a library in which ``REAL`` is the given type, or None where it cannot be had.

    The library is kept under ``$XDG_CACHE_HOME/kornia_tidy`` (``~/.cache/kornia_tidy``), named after all that it
    depends on: source, compiler, flags and processor. ``$CC`` chooses the compiler; what
    follows its name goes to it after our own flags. Why there is none goes to the log
    of this module.

    Args:
        source: a file of C.
        dtype: ``torch.float32`` or ``torch.float64``.

    Example:
        >>> compiled(Path("/does/not/exist.c"), torch.float32) is None
        True
    """
    words = shlex.split(os.environ.get("CC", "")) or list(filter(None, map(shutil.which, ("cc", "gcc", "clang"))))[:1]
    if not words:
        _log.info("no C compiler was found: %s is not used", source.name)
        return None
    compiler, *options = words
    try:
        folder = _private_folder()
        # Threads are OpenMP's, which PyTorch has brought along; a compiler without it gives one thread.
        for extra in (("-fopenmp",), ()):
            flags = (*FLAGS, NATIVE.get(platform.machine(), "-mcpu=native"), *extra, f"-DREAL={REALS[dtype]}", *options)
            library = folder / f"{source.stem}-{_digest(source, compiler, flags)}.so"
            if library.is_file() or _compile(source, library, [compiler, *flags]):
                return ctypes.CDLL(str(library))
    except (OSError, subprocess.SubprocessError) as error:
        _log.info("%s is not used: %s", source.name, error)
    return None


def _private_folder() -> Path:
    """Return the folder of compiled libraries, which no one else may write to."""
    folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "kornia_tidy"
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    status = folder.stat()
    if hasattr(os, "getuid") and (status.st_uid != os.getuid() or status.st_mode & 0o022):
        raise PermissionError(f"{folder} must belong to the user and be writable for no one else")
    return folder


def _digest(source: Path, compiler: str, flags: tuple[str, ...]) -> str:
    """Name all that a library depends on in 16 digits. One source may include others of its folder."""
    sources = [SHARED, *sorted(source.parent.glob("*.c"))]
    parts = [
        *(path.read_bytes() for path in sources),
        source.name.encode(),
        compiler.encode(),
        " ".join(flags).encode(),
        _processor(),
    ]
    return hashlib.sha256(b"\0".join(parts)).hexdigest()[:16]


@cache
def _processor() -> bytes:
    """What the processor is and can do: a home folder may be shared by unlike machines."""
    try:
        lines = Path("/proc/cpuinfo").read_bytes().split(b"\n\n")[0].splitlines()
    except OSError:
        return f"{platform.machine()} {platform.processor()}".encode()
    kept = (b"model name", b"flags", b"Features", b"CPU part")
    return b"\n".join(line for line in lines if line.startswith(kept))


def _compile(source: Path, library: Path, command: list[str]) -> bool:
    """Write the library whole or not at all. A compiler that says no is no error: say so in the log."""
    with tempfile.TemporaryDirectory(dir=library.parent) as folder:
        new = Path(folder) / library.name
        ended = subprocess.run(  # noqa: S603 (the user's own compiler)
            [*command, "-o", str(new), str(source)], capture_output=True, text=True, timeout=SECONDS, check=False
        )
        if ended.returncode != 0:
            _log.info("%s did not compile: %s", source.name, ended.stderr[-500:])
            return False
        new.replace(library)
    return True
