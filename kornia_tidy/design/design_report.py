"""Files of a co-design: the recommended camera, the best masks, and the table of candidates and finalists as JSON."""

from __future__ import annotations

import json
import math
from typing import Any

from safetensors.torch import save

from kornia_tidy.data.npy import encode_npy
from kornia_tidy.design.candidates import Candidate
from kornia_tidy.design.co_design import CoDesign
from kornia_tidy.design.design_task import DesignTask
from kornia_tidy.psf.camera_settings import settings_of

CAMERA, MASKS, DATA, PICTURE = "camera.safetensors", "masks.npy", "report.json", "design.png"


def design_files(design: CoDesign) -> dict[str, bytes]:
    """Return the files of a co-design by name.

    Args:
        design: the result.

    Returns:
        The state of the recommended camera (``camera.safetensors``), the heights of the best masks in metres
        (``masks.npy``, (K, N, N), whether they are recommended or not) and ``report.json``.
    """
    masks = design.verdict.coded.candidate.masks
    return {
        CAMERA: save({name: value.contiguous() for name, value in design.optics().state_dict().items()}),
        MASKS: b"" if masks is None else encode_npy(masks.heights().detach().double().numpy()),
        DATA: (json.dumps(report_data(design), indent=1, allow_nan=False) + "\n").encode(),
    }


def report_data(design: CoDesign) -> dict[str, Any]:
    """Return a co-design as plain data for JSON. Numbers that are unknown or infinite are None."""
    verdict = design.verdict
    return {
        "words": design.words,
        "recommended": _candidate_data(design.task, design.recommended),
        "gain_dB": verdict.gain,
        "standard_error_dB": verdict.standard_error,
        "scenes": verdict.scenes,
        "full_well_electrons": design.task.capacity,
        "saturating_f_number": design.task.saturating_f_number,
        "task": task_data(design.task),
        "finalists": [
            {
                **_candidate_data(design.task, one.candidate),
                "settings": one.settings,
                "score_dB": one.score,
                "image_psnr_dB": _known(one.image),
                "depth_rmse": _known(one.depth),
            }
            for one in design.finalists
        ],
        "candidates": [_candidate_data(design.task, one) for one in design.candidates],
    }


def task_data(task: DesignTask) -> dict[str, Any]:
    """Return the given quantities of a task as plain data for JSON."""
    data = settings_of(task)
    return {**data, "depth_range": [_known(depth) for depth in task.depth_range]}


def _candidate_data(task: DesignTask, one: Candidate) -> dict[str, Any]:
    return {
        "start": one.start,
        "f_number": one.f_number,
        "focus_m": _known(focus_distance(task, one)),
        "restoration_error": _known(one.image_error),
        "depth_error": _known(one.depth_error),
        "cost_dB": one.cost,
    }


def exposure_in_words(design: CoDesign) -> str:
    """Return where the full well limits the exposure, and whether it does in a camera that was compared."""
    task = design.task
    limit = f"White fills the well of {task.capacity:.6g} electrons at f/{task.saturating_f_number:.3g}"
    bound = [one.candidate.f_number for one in design.finalists if one.candidate.f_number < task.saturating_f_number]
    if not bound:
        return f"{limit}, a wider aperture than any that was compared."
    return f"{limit}: wider apertures are exposed for a shorter time (here f/{min(bound):.3g})."


def focus_distance(task: DesignTask, one: Candidate) -> float:
    """Return the distance in focus in metres."""
    return float(task.camera(one.f_number, one.focus).focus_distance)


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None
