"""Conditions of a sweep: scene, version and machine."""

from __future__ import annotations

import os
import platform
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import torch
from torch import Tensor

from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.version import __version__


@dataclass(frozen=True)
class Conditions:
    """Scene, version and machine of a sweep, which decide whether its rows can be compared with those of another.

    Args:
        scene: name of the scene.
        height: rows of the image in pixels.
        width: columns.
        channels: 1 or 3.
        masks: number K of masks in one exposure.
        compositing: ``"gather"``, ``"scatter"`` or ``"occlusion"``.
        reference: the setting that errors are measured against.
        version: of the library.
        torch: version of PyTorch.
        device: the processor's name.
        threads: of PyTorch on a CPU.
        date: when the sweep began, UTC, ISO 8601.
    """

    scene: str
    height: int
    width: int
    channels: int
    masks: int
    compositing: str
    reference: str
    version: str
    torch: str
    device: str
    threads: int
    date: str

    @classmethod
    def here_and_now(cls, scene: str, optics: TiDyOptics, image: Tensor, reference: str = "reference") -> Conditions:
        """Return the conditions of a sweep that starts now."""
        height, width = image.shape[-2:]
        return cls(
            scene=scene,
            height=height,
            width=width,
            channels=image.shape[-3],
            masks=optics.masks.phase.shape[0],
            compositing=optics.compositing,
            reference=reference,
            version=__version__,
            torch=torch.__version__,
            device=device_name(image.device),
            threads=torch.get_num_threads(),
            date=datetime.now(UTC).isoformat(timespec="seconds"),
        )


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
