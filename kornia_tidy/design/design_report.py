"""Report of a co-design: the table of candidates and finalists in words, as Markdown and as JSON, and the files."""

from __future__ import annotations

import io
import json
import math
from typing import Any

import numpy as np
from safetensors.torch import save

from kornia_tidy.design.candidates import Candidate
from kornia_tidy.design.co_design import CoDesign
from kornia_tidy.design.design_task import DesignTask
from kornia_tidy.design.verdict import Finalist
from kornia_tidy.psf.camera_settings import settings_of

CAMERA, MASKS, REPORT, DATA, PICTURE = "camera.safetensors", "masks.npy", "report.md", "report.json", "design.png"


def design_files(design: CoDesign) -> dict[str, bytes]:
    """Return the files of a co-design by name.

    Args:
        design: the result.

    Returns:
        The state of the recommended camera (``camera.safetensors``), the heights of the best masks in metres
        (``masks.npy``, (K, N, N), whether they are recommended or not), ``report.md`` and ``report.json``.
    """
    heights = io.BytesIO()
    masks = design.verdict.coded.candidate.masks
    if masks is not None:
        np.save(heights, masks.heights().detach().double().numpy())
    return {
        CAMERA: save({name: value.contiguous() for name, value in design.optics().state_dict().items()}),
        MASKS: heights.getvalue(),
        REPORT: report_markdown(design).encode(),
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


def report_markdown(design: CoDesign) -> str:
    """Return a co-design as a page of Markdown."""
    task, verdict = design.task, design.verdict
    near, far = task.depth_range
    matters = {0.0: "the image alone", 1.0: "depth alone"}.get(
        task.depth_weight, f"the image by {1 - task.depth_weight:g} and depth by {task.depth_weight:g}"
    )
    lines = [
        "# Co-design of aperture and masks",
        "",
        f"**{design.words}**",
        "",
        f"![Search, simulated captures, masks and PSFs]({PICTURE})",
        "",
        f"Depths {near:g} to {far:g} m, lens {task.focal_length * 1e3:g} mm, pixels of {task.pixel_pitch * 1e6:g} um, "
        f"{task.electrons:g} electrons of white at f/{task.reference_f_number:g} in the same exposure time at every "
        f"f-number, read noise {task.read_noise:g} electrons. {exposure_in_words(design)} K = {task.masks} "
        f"masks of {task.mask_size} x {task.mask_size} pixels; modulator: {_modulator_in_words(task)}. What matters: "
        f"{matters}.",
        "",
        "## Simulated captures",
        "",
        f"Each camera took {2 * verdict.scenes} scenes or one less. PSFs of 129 pixels, the light beyond as a uniform "
        f"background. Restored by the closed form whose settings were best on half of the scenes; the {verdict.scenes} "
        "others give the scores. The best flat lens and the best masks are chosen on the first half too, so their "
        "difference is not flattered by the choice.",
        "",
        "| camera | f-number | focus, m | image, dB | depth RMSE (of the range) | closed form |",
        "|---|---|---|---|---|---|",
        *(_finalist_row(task, one, one in (verdict.flat, verdict.coded)) for one in design.finalists),
        "",
        f"Best masks against best flat lens: {verdict.gain:+.2f} dB, standard error {verdict.standard_error:.2f} dB "
        f"over {verdict.scenes} scenes.",
        "",
        "## Search",
        "",
        "Error of the best linear restoration with one filter for all depths, by the statistics of scenes, relative to "
        "a uniform image; expected error of inverse depth from texture, as a fraction of the range.",
        "",
        "| start | f-number | focus, m | restoration error | depth error |",
        "|---|---|---|---|---|",
        *(_candidate_row(task, one) for one in sorted(design.candidates, key=lambda one: one.cost)),
        "",
        f"Files: `{CAMERA}` is the recommended camera, `{MASKS}` the heights of the best masks in metres, "
        f"`{DATA}` this page as data.",
        "",
    ]
    return "\n".join(lines)


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


def _finalist_row(task: DesignTask, one: Finalist, is_best: bool) -> str:
    candidate, form = one.candidate, "; ".join(one.settings.values())
    name = "flat lens" if candidate.is_flat else f"K = {task.masks}, {candidate.start}"
    name = f"**{name}**" if is_best else name
    focus = f"{focus_distance(task, candidate):.3g}"
    return (
        f"| {name} | {candidate.f_number:.3g} | {focus} | {_number(one.image, '.2f')} | {_number(one.depth, '.3f')} | "
        f"{form} |"
    )


def _candidate_row(task: DesignTask, one: Candidate) -> str:
    return (
        f"| {one.start} | {one.f_number:.3g} | {focus_distance(task, one):.3g} | {_number(one.image_error, '.4f')} | "
        f"{_number(one.depth_error, '.2g')} |"
    )


def _modulator_in_words(task: DesignTask) -> str:
    words = (part.extra_repr() for part in task.modulator.modules())
    return "; ".join(part for part in words if part) or type(task.modulator).__name__


def _number(value: float, form: str) -> str:
    return f"{value:{form}}" if math.isfinite(value) else "-"


def _known(value: float) -> float | None:
    return value if math.isfinite(value) else None
