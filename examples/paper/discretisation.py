"""Experiment 8, the paper's discretisation: masks and networks that were trained with it, in a physical camera.

    python -m examples.paper.discretisation --scale smoke
    python -m examples.paper.discretisation --scale cpu

The same training with the published discretisation (fidelity ``paper``: PSFs that wrap around and lose red and green
light at the ends of the range) and with honest sampling (``balanced``). Both are then evaluated with ``reference``
optics. Masks that were trained with correlation are turned by 180 degrees for it, so that their PSFs are not flipped.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from examples.paper.cameras import REFERENCE, flat_lens
from examples.paper.report import bars, cell, grid, means
from examples.paper.runner import Experiment, Row, Trial, main
from examples.paper.scenes import BUDGETS, Budget
from examples.paper.training import best_flat, closed_form_system, prefixed, scores_of, train
from kornia_tidy import Fidelity, PixelwiseMask, SensorNoise, TiDyOptics
from kornia_tidy.masks.initial_heights import initial_heights
from kornia_tidy.reconstruction.trained import TrainedSystem, fix_window

FLAT = "best lens without masks"
NOISE = 0.01  # of full scale, as PhaseCam3D; the paper states none
WINDOW = {"smoke": 45, "cpu": 95}  # pixels of the reference's PSFs, else 129; the light beyond is an even background
TRIALED = (("edof", "5"), ("depth", "5"), ("edof", "1"))


def trials(scale: str) -> list[Trial]:
    """Return the trials: each task, number of masks, fidelity and seed."""
    return [
        {"task": task, "masks": masks, "learnt": learnt, "seed": str(seed)}
        for seed in range(BUDGETS[scale].seeds)
        for task, masks in (*TRIALED, ("edof", FLAT))
        for learnt in (("balanced",) if masks == FLAT else ("paper", "balanced"))
    ]


def measure(trial: Trial, scale: str) -> Mapping[str, float | str]:
    """Train with one fidelity and return the scores as trained and with the optics of the reference."""
    budget, task, seed = BUDGETS[scale], trial["task"], int(trial["seed"])
    reference = Fidelity.preset("reference").replace(window=WINDOW.get(scale, 129), double=False)
    if trial["masks"] == FLAT:
        lens = best_flat("edof", budget)
        physical = flat_lens(*lens, reference)
        system = train(flat_lens(*lens, budget.fidelity), task, budget, seed)
        found = prefixed("trained", scores_of(system, budget)) | prefixed(
            "reference", elsewhere(system, physical, budget)
        )
        return found | prefixed("physical", scores_of(closed_form_system(physical, task, budget), budget))
    fidelity = Fidelity.preset("paper") if trial["learnt"] == "paper" else budget.fidelity
    masks = first_masks(int(trial["masks"]), task, seed)
    first = camera(mounted(masks, fidelity), reference)
    found = prefixed("first", scores_of(closed_form_system(first, task, budget), budget))
    optics = camera(masks, fidelity)
    system = train(optics, task, budget, seed)
    found |= prefixed("trained", scores_of(system, budget))
    physical = mounted(optics.masks, fidelity)
    if trial["learnt"] == "paper":
        bright = fidelity.replace(stray_light="renormalize")
        found |= prefixed("uncast", elsewhere(system, camera(optics.masks, bright), budget))
        found |= prefixed("sampled", elsewhere(system, camera(physical, reference, color_space="paper"), budget))
        found |= color_cast(optics)
    found |= prefixed("reference", elsewhere(system, camera(physical, reference), budget))
    return found | prefixed(
        "physical", scores_of(closed_form_system(camera(physical, reference), task, budget), budget)
    )


def first_masks(count: int, task: str, seed: int) -> PixelwiseMask:
    """Return the first masks: noise for images, three Fisher masks and two noisy ones for depth."""
    generator = torch.Generator().manual_seed(seed)
    if task == "depth":
        return PixelwiseMask(initial=initial_heights("3 fishers, 2 noisy", generator)[:count])
    return PixelwiseMask(count, generator=generator)


def camera(masks: Any, fidelity: Fidelity, **parts: Any) -> TiDyOptics:
    """Return the camera of the experiment, with the noise of PhaseCam3D whatever the fidelity."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="the paper's 23x23 pupil")  # the aliasing is measured here
        return fix_window(TiDyOptics(masks, REFERENCE, sensor=SensorNoise(NOISE), fidelity=fidelity, **parts))


def mounted(masks: Any, fidelity: Fidelity) -> PixelwiseMask:
    """Return a copy of masks for a camera that convolves: turned by 180 degrees if they were trained to correlate."""
    heights = masks.heights().detach()
    return PixelwiseMask(initial=heights.flip((-2, -1)) if fidelity.correlate else heights)


def elsewhere(system: TrainedSystem, optics: TiDyOptics, budget: Budget) -> dict[str, float]:
    """Return the scores of a system's network behind another camera."""
    return scores_of(system._replace(optics=optics.eval()), budget)


def color_cast(optics: TiDyOptics) -> dict[str, float]:
    """Return how much brighter blue is than red where the defocus is largest, and in focus."""
    with torch.no_grad():
        light = optics.psf_bank(3, defocus=[-20.0, 0.0, 20.0]).psfs.sum((-2, -1))
    ends, focus = light[[0, 2], 2] / light[[0, 2], 0], light[1, 2] / light[1, 0]
    return {"cast_ends": float(ends.mean()), "cast_focus": float(focus)}


COLUMNS = {
    "trained": "network, as trained",
    "uncast": "PSFs scaled to sum one",
    "sampled": "reference PSFs, encoded light",
    "reference": "reference, linear light",
    "physical": "closed form, reference, masks learnt",
    "first": "closed form, reference, masks at the start",
}


def table(rows: Sequence[Row], scale: str) -> str:
    """Return a table for each task."""
    parts = []
    for task, words in (("edof", "Extended depth of field, PSNR in dB"), ("depth", "Depth, RMSE (times 20)")):
        if not any(row["task"] == task for row in rows):
            continue
        parts.append(f"**{words}**; painted scenes / real scenes, mean ± standard error over seeds:")
        lines = []
        kinds = dict.fromkeys((row["masks"], row["learnt"]) for row in rows if row["task"] == task)
        for masks, learnt in kinds:
            own = [row for row in rows if (row["task"], row["masks"], row["learnt"]) == (task, masks, learnt)]
            lines.append([masks, learnt, str(len(own)), *(cell(own, name, task) for name in COLUMNS)])
        parts.append(grid(["masks", "learnt with", "seeds", *COLUMNS.values()], lines))
    cast = means(rows, "cast_ends"), means(rows, "cast_focus")
    if cast[0]:
        ends, focus = (sum(values) / len(values) for values in cast)
        parts.append(
            f"Colour cast of `paper`: blue over red {ends:.2f} at the ends of the range, {focus:.2f} in focus."
        )
    return "\n\n".join([*parts, JUDGED])


JUDGED = """\
From left to right, each column takes away one thing that the training had: first the colour cast, then the wrapped and
cropped PSFs, then light that is encoded before it is blurred. The step from *as trained* to *scaled to sum one* is what
the network had from the colour cast and from the light that the crop loses, which it learns to make up for. The last
two columns ask for the masks alone: a closed form behind them in a physical camera, after and before training. Judged
can be these differences for masks of so few steps. Not judged can be masks trained to convergence, which may exploit
aliasing more. The paper did not measure this. The noise is 0.01 of full scale in all rows but that of the lens without
masks, whose shot noise at a fifth of full scale is 0.01 at f/17.6."""


def draw(rows: Sequence[Row], path: Path) -> None:
    """Draw the scores of the networks over the steps from the training to the reference."""
    panels = {}
    for task, masks, score in (("edof", "5", "psnr"), ("depth", "5", "rmse")):
        series = {}
        for learnt in ("paper", "balanced"):
            own = [row for row in rows if (row["task"], row["masks"], row["learnt"]) == (task, masks, learnt)]
            series[f"learnt with {learnt}"] = {name: means(own, f"{name}_painted_{score}") for name in COLUMNS}
        panels[f"{'PSNR, dB' if task == 'edof' else 'depth RMSE'}, 5 masks"] = series
    bars(panels, path, "evaluated")


def settings(scale: str) -> str:
    """Return what the results depend on."""
    return f"Budget of each row: {BUDGETS[scale].words}. Reference PSFs of {WINDOW.get(scale, 129)} px, float32."


EXPERIMENT = Experiment("discretisation", "8. The paper's discretisation", trials, measure, table, settings, draw)

if __name__ == "__main__":
    sys.exit(not main(EXPERIMENT, __doc__ or ""))
