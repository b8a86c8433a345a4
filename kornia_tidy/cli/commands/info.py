"""`kornia-tidy info`: the environment of the library."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from itertools import product

PACKAGES = (
    *("torch", "kornia", "numpy", "opencv-contrib-python-headless", "colour-science", "rawpy", "safetensors"),
    *("lightning", "matplotlib", "h5py", "OpenEXR"),
)

# in kornia_tidy.kernels
SOURCES = ("gather_ops", "overlap_ops", "occlusion_ops", "mutual_intensity_ops", "srgb_ops", "sensor_ops")


@dataclass(frozen=True, kw_only=True)
class Info:
    """Versions, processor, compiler and compiled code of this machine, for bug reports.

    The compiled kernels are those of the wheel, with their level of processors, or those
    compiled here, with their cache folder. Kernels that are not compiled yet are compiled,
    which takes some seconds. Please include this in bug reports.
    """

    def run(self) -> None:
        """Print the report line by line."""
        from kornia_tidy.cli.commands.report import tell

        for topic, text in lines():
            tell(topic, _without_home(text))


def lines() -> Iterator[tuple[str, str]]:
    """Yield the lines of the report as topics and texts."""
    import torch

    import kornia_tidy
    from kornia_tidy.design.tradeoff.conditions import device_name
    from kornia_tidy.kernels.build import REALS, build, vector_bytes

    sources = (import_module(f"kornia_tidy.kernels.{name}").SOURCE for name in SOURCES)
    yield "package", f"kornia_tidy {kornia_tidy.__version__}, Python {platform.python_version()}"
    yield "uses", ", ".join(f"{name} {_version(name)}" for name in PACKAGES)
    yield "system", f"{platform.system()} {platform.release()}, {platform.machine()}"
    yield "processor", device_name(torch.device("cpu"))
    yield (
        "torch",
        f"{torch.get_num_threads()} threads, vectors of {torch.backends.cpu.get_cpu_capability()}, "
        f"MKL {'yes' if torch.backends.mkl.is_available() else 'no'}, accelerator {_accelerator()}",
    )
    yield "compiler", _compiler()
    for source, dtype in product(sources, REALS):
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


def _accelerator() -> str:
    import torch

    if torch.cuda.is_available():
        return ", ".join(torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count()))
    return "mps" if torch.backends.mps.is_available() else "none"


def _compiler() -> str:
    from kornia_tidy.kernels.compiler import find_compiler

    try:
        compiler = find_compiler()
    except RuntimeError as error:
        return str(error)
    return f"{' '.join((*compiler.program, *compiler.options))}: {compiler.version}"


def _cache() -> str:
    from kornia_tidy.kernels.build import cache_folder

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
