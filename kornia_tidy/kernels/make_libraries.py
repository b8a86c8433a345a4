"""The libraries of a wheel: each C source for each level of this platform's processors, as `make wheel` asks for them.

``python -m kornia_tidy.kernels.make_libraries FOLDER`` writes them. They are linked without an OpenMP library, since
torch has opened one before: a second one in the process would keep separate threads.
"""

from __future__ import annotations

import argparse
import platform
import sys
import tempfile
from collections.abc import Sequence
from itertools import product
from pathlib import Path

import torch

from kornia_tidy.kernels.build import FLAGS, KERNELS, REALS, library_name
from kornia_tidy.kernels.compiler import THREADS, NotBuiltError, find_compiler, run
from kornia_tidy.kernels.processor import LEVELS


def make_libraries(folder: Path, machine: str = platform.machine()) -> list[Path]:
    """Compile the libraries of a wheel into a folder and return their paths.

    Args:
        folder: made if it is not there.
        machine: as :func:`platform.machine` tells it; the compiler must compile for it.

    Raises:
        NotBuiltError: if the compiler is missing or fails.
        ValueError: if wheels of that kind of machine have no libraries.
    """
    if sys.platform != "linux" or machine not in LEVELS:
        raise ValueError(f"libraries are made on Linux for {' and '.join(LEVELS)}, this is {sys.platform}, {machine}")
    folder.mkdir(parents=True, exist_ok=True)
    each = product(LEVELS[machine], sorted(KERNELS.glob("*.c")), REALS)
    return [make_library(source, dtype, level, folder) for level, source, dtype in each]


def make_library(source: Path, dtype: torch.dtype, level: str, folder: Path) -> Path:
    """Compile a C source for a level of processors into a folder and return the library's path.

    Raises:
        NotBuiltError: if the compiler is missing or fails.
    """
    compiler = find_compiler()
    path = folder.absolute() / library_name(source, dtype, level)
    flags = (*FLAGS, f"-march={level}", THREADS, f"-DREAL={REALS[dtype]}", *compiler.options)
    with tempfile.TemporaryDirectory() as own:
        part = Path(own) / "library.o"
        run([*compiler.program, *flags, "-c", "-o", str(part), str(source)])
        # Without -fopenmp, which would name a library of OpenMP.
        run([*compiler.program, "-shared", "-s", "-o", str(path), str(part), "-lm", *compiler.options])
    return path


def main(arguments: Sequence[str] | None = None) -> int:
    """Make the libraries, or say in one sentence why not."""
    parser = argparse.ArgumentParser(prog="python -m kornia_tidy.kernels.make_libraries", description=__doc__)
    parser.add_argument("folder", type=Path, help="where they go")
    args = parser.parse_args(arguments)
    try:
        paths = make_libraries(args.folder)
    except (NotBuiltError, OSError, ValueError) as error:
        parser.exit(2, f"{error}\n")
    size = sum(path.stat().st_size for path in paths) >> 10
    sys.stdout.write(f"{len(paths)} libraries, {size} KiB: {args.folder}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
