"""The C sources under the address and undefined-behaviour sanitizers, called with random shapes.

``python -m tests.kernels.sanitize`` takes a few minutes; ``--shapes 300`` a share of it. Values are checked as well
where that is cheap, so that what runs is what is meant. Linux with gcc and its sanitizers; elsewhere it says so and
ends.
"""

from __future__ import annotations

import argparse
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
SHAPES = 2500
COMPILER = "gcc -fsanitize=address,undefined -fno-sanitize-recover=all -fno-omit-frame-pointer -g -O1"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run each kernel with random shapes; 1 if a sanitizer or a comparison objects."""
    parser = argparse.ArgumentParser(prog="python -m tests.kernels.sanitize", description=__doc__.splitlines()[0])
    parser.add_argument("--shapes", type=int, default=SHAPES, help=f"random shapes for each kernel ({SHAPES})")
    parser.add_argument("--seed", type=int, default=0, help="of the shapes (0)")
    parser.add_argument("--kernel", default="", help="those whose names begin so")
    args = parser.parse_args(arguments)
    if reason := why_not():
        print(f"not run: {reason}")
        return 0
    return sanitized(args.shapes, args.seed, args.kernel).returncode


def why_not() -> str | None:
    """Return why sources cannot be sanitized on this machine, or None."""
    if sys.platform != "linux" or shutil.which("gcc") is None:
        return "sanitizers need Linux and gcc"
    return None if library("libasan.so").is_absolute() else "gcc's address sanitizer (libasan) is not on this machine"


def library(name: str) -> Path:
    """Return the file of a library of gcc's; its bare name where gcc has none."""
    told = subprocess.run(["gcc", f"-print-file-name={name}"], capture_output=True, text=True, check=True)
    return Path(told.stdout.strip())


def sanitized(
    shapes: int, seed: int, kernel: str, root: Path = ROOT, capture: bool = False
) -> subprocess.CompletedProcess[str]:
    """Call the kernels of the package in ``root`` in a process that the sanitizer's library is loaded into first."""
    with tempfile.TemporaryDirectory() as cache:
        environment = {
            **os.environ,
            "ASAN_OPTIONS": "detect_leaks=0",  # of Python, which frees little at its end
            "UBSAN_OPTIONS": "print_stacktrace=1",
            "CC": COMPILER,
            # The sanitizer looks for the functions that throw C++ exceptions when it starts; torch throws some.
            "LD_PRELOAD": f"{library('libasan.so')} {library('libstdc++.so.6')}",
            "OMP_WAIT_POLICY": "passive",  # calls are short, and threads that wait would take the others' time
            "PYTHONPATH": f"{root}{os.pathsep}{ROOT}",
            "XDG_CACHE_HOME": cache,
        }
        code = f"from tests.kernels.sanitize import call; call({shapes}, {seed}, {kernel!r})"
        command = [sys.executable, "-P", "-c", code]
        return subprocess.run(command, env=environment, cwd=cache, text=True, capture_output=capture, check=False)


def call(shapes: int, seed: int, kernel: str) -> None:
    """Call the kernels and print how often; raises if a value is wrong. Threads are one and two by turns."""
    import torch

    from kornia_tidy.kernels.build import compiled
    from tests.kernels.kernel_shapes import CHEAP, DTYPES, KERNELS
    from tests.kernels.operator_tester import MODULES

    chosen = {name: function for name, function in KERNELS.items() if name.startswith(kernel)}
    for source in (ops.SOURCE for ops in MODULES):
        for dtype in DTYPES if any(name.startswith(source.name) for name in chosen) else ():
            assert compiled(source, dtype) is not None, f"{source.name} was not compiled with: {os.environ['CC']}"
    for name, function in chosen.items():
        start, checked = time.perf_counter(), 0
        for index in range(shapes):
            torch.manual_seed(seed + index)
            torch.set_num_threads(1 + index % 2)
            result = function(random.Random(f"{name} {seed + index}"))
            if result.got is None or result.products > CHEAP:
                continue
            checked += 1
            if not (error := result.error()) <= 1:
                raise SystemExit(f"{name}, seed {seed + index}: off by {error:.1e} of the round-off: {result.about}")
        seconds = time.perf_counter() - start
        print(f"{name}: {shapes} random shapes, {checked} with values, nothing found, {seconds:.0f} s", flush=True)


if __name__ == "__main__":
    sys.exit(main())
