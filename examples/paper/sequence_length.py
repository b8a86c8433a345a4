"""Experiment 3, the number of masks: sequences of masks against one mask and none, trained under one budget.

    python -m examples.paper.sequence_length --scale smoke
    python -m examples.paper.sequence_length --scale cpu        half an hour

Masks and network are trained together for each number of masks, with the same scenes, steps and noise. The paper's
0 masks are a fixed Fresnel lens. Beside them stand the closed form behind the same masks, and the lens without masks at
its best f-number with equal exposure time.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch

from examples.paper.cameras import camera_with, flat_lens
from examples.paper.report import bars, cells, grid, means
from examples.paper.runner import Experiment, Row, Trial, main
from examples.paper.scenes import BUDGETS
from examples.paper.training import best_flat, trained_scores
from kornia_tidy import FresnelLens, PixelwiseMask, TiDyOptics
from kornia_tidy.masks.initial_heights import initial_heights

LENGTHS = ("0", "1", "2", "3", "4", "5", "8", "16")
FLAT = "flat"
OF_SCALE = {"smoke": ("0", "5"), "cpu": ("0", "1", "2", "5", FLAT)}
TASKS = ("edof", "depth", "joint")
PAPER = {  # TiDy-PSFs, tables 2 to 4; its figures of the other lengths have no numbers in the text
    ("edof", "1"): "37.33", ("edof", "5"): "41.11", ("depth", "1"): "0.026", ("depth", "5"): "0.019",
    ("joint", "1"): "31.20, 0.052", ("joint", "5"): "34.79, 0.034",
}  # fmt: skip


def trials(scale: str) -> list[Trial]:
    """Return the trials: each task, number of masks and seed."""
    return [
        {"task": task, "masks": masks, "seed": str(seed)}
        for task in TASKS
        for seed in range(BUDGETS[scale].seeds)
        for masks in OF_SCALE.get(scale, (*LENGTHS, FLAT))
    ]


def measure(trial: Trial, scale: str) -> Mapping[str, float | str]:
    """Train a camera of one number of masks and return its scores."""
    budget, task, seed = BUDGETS[scale], trial["task"], int(trial["seed"])
    lens = best_flat("depth" if task == "depth" else "edof", budget) if trial["masks"] == FLAT else (17.6, 0.5)

    def make() -> TiDyOptics:
        if trial["masks"] == FLAT:
            return flat_lens(*lens, budget.fidelity)
        if trial["masks"] == "0":
            return camera_with(FresnelLens(), budget.fidelity)
        return camera_with(first_masks(int(trial["masks"]), task, seed), budget.fidelity)

    return {"f_number": lens[0], "focus": lens[1], **trained_scores(make, task, budget, seed)}


def first_masks(count: int, task: str, seed: int) -> PixelwiseMask:
    """Return masks as the paper starts them: noise for images, noisy Fisher masks for depth."""
    generator = torch.Generator().manual_seed(seed)
    if task != "depth" or count > 5:
        return PixelwiseMask(count, generator=generator)
    return PixelwiseMask(initial=initial_heights("noisy fishers", generator)[:count])


def table(rows: Sequence[Row], scale: str) -> str:
    """Return a table for each task."""
    parts = []
    for task in dict.fromkeys(row["task"] for row in rows):
        of_task = [row for row in rows if row["task"] == task]
        parts.append(f"**{NAMES[task]}**, on painted scenes / on real scenes, mean ± standard error over seeds:")
        lines = []
        for masks in dict.fromkeys(row["masks"] for row in of_task):
            own = [row for row in of_task if row["masks"] == masks]
            lines.append([title(own), str(len(own)), *cells(own, task), PAPER.get((task, masks), "-")])
        heading = ["masks", "seeds", "network", "closed form, masks learnt", "closed form, masks at the start"]
        parts.append(grid([*heading, "the paper"], lines))
    return "\n\n".join([*parts, JUDGED])


NAMES = {
    "edof": "Extended depth of field, PSNR in dB",
    "depth": "Depth, RMSE in parts of the range (times 20: PhaseCam3D's scale)",
    "joint": "Both, PSNR in dB and RMSE of depth in parts of the range",
}
JUDGED = """\
The rows differ in masks alone: the exposure time is the same, with 2,000 electrons of white at f/17.6. Judged can be
which camera is better *after so many steps*, and what its masks are worth to a closed form, which needs no training: a
sequence is worth its length if this column rises with it. Not judged can be the paper's figure, whose networks were
trained to convergence from a pretrained start: after the steps of the smaller scales a network is far from its limit,
and behind the closed form where that says more. A score without ± was the same for all seeds. The paper's PSNR is on
other data, with another noise, which it does not state, and with its own aliased optics."""


def title(rows: Sequence[Row]) -> str:
    """Return the name of a row."""
    masks, lens = rows[0]["masks"], rows[0]
    if masks == FLAT:
        return f"none, best lens: f/{float(lens['f_number']):g}, focus at {float(lens['focus']):g} of the range"
    return "0 (Fresnel lens)" if masks == "0" else masks


def draw(rows: Sequence[Row], path: Path) -> None:
    """Draw scores over the number of masks, for network and closed form."""
    panels = {}
    for task in dict.fromkeys(row["task"] for row in rows):
        score = "rmse" if task == "depth" else "psnr"
        series = {}
        for what, words in (("network", "network"), ("closed", "closed form"), ("start", "closed form, first masks")):
            points = {}
            for masks in dict.fromkeys(row["masks"] for row in rows if row["task"] == task):
                own = [row for row in rows if row["task"] == task and row["masks"] == masks]
                points[masks] = means(own, f"{what}_painted_{score}")
            series[words] = points
        panels[f"{NAMES[task].split(',')[0]}, {'RMSE' if score == 'rmse' else 'PSNR, dB'}"] = series
    bars(panels, path, "masks")


def settings(scale: str) -> str:
    """Return what the results depend on."""
    return f"Budget of each row: {BUDGETS[scale].words}. Paper: 300 epochs of 5,077 scenes."


EXPERIMENT = Experiment("sequence_length", "3. The number of masks", trials, measure, table, settings, draw)

if __name__ == "__main__":
    sys.exit(not main(EXPERIMENT, __doc__ or ""))
