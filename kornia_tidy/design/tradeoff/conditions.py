"""Conditions of a sweep: scene, code and machine, which decide whether rows can be compared."""

from __future__ import annotations

import hashlib
import os
import platform
import subprocess
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import torch
from torch import Tensor

from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.optics.aperture import OpenArea
from kornia_tidy.search_path import ROOT, find_program
from kornia_tidy.version import __version__

PACKAGE = Path(__file__).parents[2]
MEASURED_CODE = (
    "**/*.c",
    "**/*.h",
    "camera/*.py",
    "checks.py",
    "fidelity.py",
    "kernels/**/*.py",
    "masks/**/*.py",
    "modulator/**/*.py",
    "optics/**/*.py",
    "accuracy/**/*.py",
    "psf/**/*.py",
    "render/**/*.py",
    "mode.py",
    "sensor/*.py",
    "design/tradeoff/costs.py",
    "design/tradeoff/sweep_settings.py",
    "design/tradeoff/measure.py",
)


@dataclass(frozen=True)
class Conditions:
    """Scene, code and machine of a sweep. Rows of two sweeps can be compared if :meth:`same` is True.

    Args:
        scene: name of the scene.
        scene_hash: of image, depth, masks, lens, spectrum and everything else but the fidelity that affects a capture.
        height: rows of the image in pixels.
        width: columns.
        channels: 1 or 3.
        masks: number K of masks in one exposure.
        compositing: ``"gather"``, ``"scatter"`` or ``"occlusion"``.
        reference: the setting that errors are measured against.
        version: of the library.
        code_hash: of the library's source.
        commit: of the library's git repository, with ``-dirty`` for changes on top; None outside of one.
        torch: version of PyTorch.
        device: the processor's name.
        threads: of PyTorch on a CPU.
        date: when the sweep was last added to, UTC, ISO 8601.
    """

    scene: str
    scene_hash: str
    height: int
    width: int
    channels: int
    masks: int
    compositing: str
    reference: str
    version: str
    code_hash: str
    commit: str | None
    torch: str
    device: str
    threads: int
    date: str

    @classmethod
    def here_and_now(
        cls, scene: str, optics: TiDyOptics, image: Tensor, depth: Tensor, reference: str = "reference"
    ) -> Conditions:
        """Return the conditions of a sweep that starts now."""
        height, width = image.shape[-2:]
        return cls(
            scene=scene,
            scene_hash=scene_hash(optics, image, depth),
            height=height,
            width=width,
            channels=image.shape[-3],
            masks=optics.masks.phase.shape[0],
            compositing=optics.compositing,
            reference=reference,
            version=__version__,
            code_hash=code_hash(),
            commit=git_commit(),
            torch=torch.__version__,
            device=device_name(image.device),
            threads=torch.get_num_threads(),
            date=datetime.now(UTC).isoformat(timespec="seconds"),
        )

    def same(self, other: Conditions) -> bool:
        """Return whether rows measured under other conditions can be compared: name, commit and date may differ."""
        rest = {"scene": "", "commit": None, "date": ""}
        return replace(self, **rest) == replace(other, **rest)


def scene_hash(optics: TiDyOptics, image: Tensor, depth: Tensor) -> str:
    """Return a hash of everything that affects a noise-free capture, except the fidelity and the code."""
    digest = hashlib.sha256()
    parts = [part for part in (optics.masks, optics.camera, optics.modulator) for part in part.modules()]
    state = [tensor for part in parts for tensor in (*part.parameters(False), *part.buffers(False))]
    for tensor in (image, depth, optics.pupil.amplitude, *state):
        digest.update(f"{tensor.dtype} {tuple(tensor.shape)}".encode())
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    if isinstance(optics.aperture, OpenArea):
        digest.update(b"open area")
    for part in parts:
        plain = {k: v for k, v in vars(part).items() if isinstance(v, str | int | float | tuple) and k != "training"}
        digest.update(f"{type(part).__name__} {sorted(plain.items())}".encode())
    colours = [optics.masks.dispersion(wavelength) for wavelength in optics.spectrum.wavelengths]
    rest = (optics.spectrum, colours, optics.compositing, optics.border, optics.color_space)
    digest.update(repr(rest).encode())
    return digest.hexdigest()[:16]


def code_hash() -> str:
    """Return a hash of the source code of a capture, so that rows of different versions are not mixed."""
    digest = hashlib.sha256()
    for path in measured_files(PACKAGE):
        digest.update(f"{path.relative_to(PACKAGE).as_posix()} {path.stat().st_size}\n".encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def measured_files(root: Path) -> list[Path]:
    """Return the Python and C files that affect a row: optics, rendering, sensor, planner and measurement."""
    return [path for pattern in MEASURED_CODE for path in sorted(root.glob(pattern))]


def git_commit() -> str | None:
    """Return the commit of the repository that the library is run from, or None if it is run from elsewhere."""

    def git(*words: str) -> str:
        command = [find_program("git"), "-C", str(PACKAGE), *words]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, check=True, text=True)  # noqa: S603
        return done.stdout.strip()

    try:
        git("ls-files", "--error-unmatch", "__init__.py")  # else it is an enclosing repository
        return git("describe", "--always", "--dirty", "--exclude=*", "--abbrev=12")
    except (OSError, subprocess.CalledProcessError):
        return None


def device_name(device: torch.device) -> str:
    """Return the model name of a device."""
    if device.type == "cuda":
        return torch.cuda.get_device_name(device)
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        name = next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        name = platform.processor() or platform.machine()
    return f"{name}, {os.cpu_count()} CPUs"
