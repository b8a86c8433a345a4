"""Settings of a training from the folder of a design: the recommended camera and its light."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

from kornia_tidy.design.candidates import FLAT
from kornia_tidy.design.design_report import CAMERA, DATA
from kornia_tidy.files import error_prefix, read_json
from kornia_tidy.modulator.modulator import DwellTimes
from kornia_tidy.psf.camera_settings import settings_of


def designed_settings(folder: str | os.PathLike[str]) -> dict[str, Any]:
    """Return the settings of the camera that a design recommends, for a training behind it.

    Args:
        folder: that ``kornia-tidy design`` wrote.

    Returns:
        Lens, depth range, number and size of masks as settings of
        :class:`~kornia_tidy.training.settings.TrainingSettings`. The masks themselves are in the file of
        :func:`designed_camera`. A recommended flat lens is one mask of zero height.

    Raises:
        FileNotFoundError: if the folder holds no report of a design.
        ValueError: if the report is damaged, or of a real lens, or of masks that are shown by a modulator with
            switching, levels or losses, which trained systems do not have.
    """
    path = Path(folder) / DATA
    report = read_json(path)
    with error_prefix(f"cannot read {path}: it is no report of kornia-tidy design, or is damaged", KeyError, TypeError):
        task, camera = report["task"], report["recommended"]
        flat, modulator = camera["start"] == FLAT, task["modulator"]
        near, far = task["depth_range"]
        settings = {
            "focal_length": float(task["focal_length"]),
            "pixel_pitch": float(task["pixel_pitch"]),
            "depth_range": (near, math.inf if far is None else far),
            "f_number": float(camera["f_number"]),
            "focus_distance": math.inf if camera["focus_m"] is None else float(camera["focus_m"]),
            "masks": 1 if flat else task["masks"],
            "start": "flat" if flat else "noise",
            "mask_size": task["mask_size"],
            "reference_f_number": float(task["reference_f_number"]),
        }
    if lens := task.get("lens"):
        raise ValueError(
            f"{folder} has cameras behind the lens {lens}, and a trained system has an ideal lens: design "
            f"without --lens"
        )
    if not flat and modulator != settings_of(DwellTimes()):
        raise ValueError(
            f"the masks of {folder} were designed for a modulator with switching, levels or losses, and a trained "
            f"system shows them for equal times without delay: design them without --bits and --switching-time"
        )
    return settings


def designed_camera(folder: str | os.PathLike[str]) -> Path:
    """Return the file of the camera that a design recommends, with its masks."""
    return Path(folder) / CAMERA
