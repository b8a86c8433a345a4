"""`kornia-tidy info`: versions, processor, compiler and compiled code of this machine, for bug reports."""

from __future__ import annotations

import argparse
import os
import platform
import re
from collections.abc import Iterator
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from itertools import product
from pathlib import Path
from typing import Any

import torch

import kornia_tidy
from kornia_tidy.commands.report import tell
from kornia_tidy.kernels import gather_ops, mutual_intensity_ops, occlusion_ops, overlap_ops, srgb_ops
from kornia_tidy.kernels.build import REALS, build, cache_folder, vector_bytes
from kornia_tidy.kernels.compiler import Compiler, find_compiler

DESCRIPTION = """\
Print the environment of kornia_tidy: versions of packages, processor and threads, the C
compiler, and the compiled kernels: those of the wheel, with their level of processors, or
those compiled here, with their cache folder. Kernels that are not compiled yet are compiled,
which takes some seconds. Please include this in bug reports.
"""

PACKAGES = (
    *("torch", "kornia", "numpy", "opencv-contrib-python-headless", "colour-science", "rawpy", "safetensors"),
    *("lightning", "matplotlib", "h5py", "OpenEXR"),
)
SOURCES = tuple(ops.SOURCE for ops in (gather_ops, overlap_ops, occlusion_ops, mutual_intensity_ops, srgb_ops))


def add_parser(subparsers: Any) -> None:
    """Describe the command to argparse."""
    parser = subparsers.add_parser(
        "info",
        help="versions, processor, compiler and compiled code, for bug reports",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)


def run(_: argparse.Namespace) -> None:
    """Print the report line by line."""
    for topic, text in lines():
        tell(topic, _without_home(text))


def lines() -> Iterator[tuple[str, str]]:
    """Yield the lines of the report as topics and texts."""
    yield "package", f"kornia_tidy {kornia_tidy.__version__}, Python {platform.python_version()}"
    yield "uses", ", ".join(f"{name} {_version(name)}" for name in PACKAGES)
    yield "system", f"{platform.system()} {platform.release()}, {platform.machine()}"
    yield "processor", f"{_processor_name()}, {os.cpu_count()} cores"
    yield (
        "torch",
        f"{torch.get_num_threads()} threads, vectors of {torch.backends.cpu.get_cpu_capability()}, "
        f"MKL {'yes' if torch.backends.mkl.is_available() else 'no'}, accelerator {_accelerator()}",
    )
    yield "compiler", _compiler()
    for source, dtype in product(SOURCES, REALS):
        name = f"{source.name}, {str(dtype).removeprefix('torch.')}"
        built = build(source, dtype)
        if built.path is None or built.library is None:
            yield "kernel", f"{name}: not there: {built.remark}"
        else:
            threads = "" if built.threads else ", in one thread"
            remark = f": {built.remark}" if built.remark else ""
            width = f"vectors of {vector_bytes(built.library)} bytes"
            yield "kernel", f"{name}: {built.origin}{threads}, {width}, {built.path.name}{remark}"
    yield "cache", _cache()


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def _processor_name() -> str:
    try:
        found = re.search(r"^model name\s*:\s*(.+)$", Path("/proc/cpuinfo").read_text(), re.MULTILINE)
    except OSError:
        found = None
    return found[1] if found else platform.processor() or "unknown"


def _accelerator() -> str:
    if torch.cuda.is_available():
        return ", ".join(torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count()))
    return "mps" if torch.backends.mps.is_available() else "none"


def _compiler() -> str:
    try:
        compiler: Compiler = find_compiler()
    except RuntimeError as error:
        return str(error)
    return f"{' '.join((*compiler.program, *compiler.options))}: {compiler.version}"


def _cache() -> str:
    try:
        folder = cache_folder()
    except OSError as error:
        return f"none: {error}"
    sizes = []
    for path in folder.iterdir():
        with suppress(OSError):  # another process may remove it at any moment
            if path.is_file():
                sizes.append(path.stat().st_size)
    return f"{folder}, {len(sizes)} files, {sum(sizes) >> 10} KiB"


def _without_home(text: str) -> str:
    """Replace the home folder in a path by ``~``, to keep the user's name out of public reports."""
    home = os.path.expanduser("~")
    return text.replace(home, "~") if len(home) > 1 else text
