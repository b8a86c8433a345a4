"""`kornia-tidy info`: the environment of the library."""

from __future__ import annotations

import os
import platform
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version

PACKAGES = (
    *("torch", "kornia", "numpy", "opencv-contrib-python-headless", "colour-science", "rawpy", "safetensors"),
    *("lightning", "matplotlib", "h5py", "OpenEXR"),
)


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
    from kornia_tidy.kernels.report import kernels_in_words

    yield "package", f"kornia_tidy {kornia_tidy.__version__}, Python {platform.python_version()}"
    yield "uses", ", ".join(f"{name} {_version(name)}" for name in PACKAGES)
    yield "system", f"{platform.system()} {platform.release()}, {platform.machine()}"
    yield "processor", device_name(torch.device("cpu"))
    yield (
        "torch",
        f"{torch.get_num_threads()} threads, vectors of {torch.backends.cpu.get_cpu_capability()}, "
        f"MKL {'yes' if torch.backends.mkl.is_available() else 'no'}, accelerator {_accelerator()}",
    )
    yield from kernels_in_words()


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


def _without_home(text: str) -> str:
    """Replace the home folder in a path by ``~``, to keep the user's name out of public reports."""
    home = os.path.expanduser("~")
    return text.replace(home, "~") if len(home) > 1 else text
