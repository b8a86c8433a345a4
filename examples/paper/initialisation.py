"""Experiment 4, the first masks for depth: does it matter from which masks the training of a depth camera starts?

    python -m examples.paper.initialisation --scale smoke
    python -m examples.paper.initialisation --scale cpu

The paper's four starts of five masks, each trained with the same network, scenes and steps. Beside the network stand
two yardsticks without one: the closed form's depth, and the Cramér-Rao bound on the depth of a bright point.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch

from examples.paper.cameras import camera_with, flat_lens
from examples.paper.closed_forms import depth_limit
from examples.paper.report import bars, cells, grid, mean_and_error, means
from examples.paper.runner import Experiment, Row, Trial, main
from examples.paper.scenes import BUDGETS
from examples.paper.training import best_flat, constant_depth, prefixed, trained_scores
from kornia_tidy import PixelwiseMask, TiDyOptics
from kornia_tidy.masks.initial_heights import initial_heights

PAPER = {"fisher, noise": 0.0329, "fisher, noisy fishers": 0.0271, "noise": 0.0254, "3 fishers, 2 noisy": 0.0207}
"""RMSE of TiDy-PSFs, table 1, after 200 epochs, by the start's name in this library."""
FLAT = "best lens without masks"
CONSTANT = "no camera: the mean depth of the training scenes"


def trials(scale: str) -> list[Trial]:
    """Return the trials: each start and seed."""
    seeds = range(BUDGETS[scale].seeds)
    return [
        {"start": CONSTANT, "seed": "0"},
        *({"start": start, "seed": str(seed)} for seed in seeds for start in (*PAPER, FLAT)),
    ]


def measure(trial: Trial, scale: str) -> Mapping[str, float | str]:
    """Train from one start and return the scores, and the bounds before and after."""
    budget, start, seed = BUDGETS[scale], trial["start"], int(trial["seed"])
    if start == CONSTANT:
        return prefixed("network", constant_depth(budget))
    made: list[TiDyOptics] = []

    def make() -> TiDyOptics:
        if start == FLAT:
            optics = flat_lens(*best_flat("depth", budget), budget.fidelity)
        else:
            heights = initial_heights(start, torch.Generator().manual_seed(seed))
            optics = camera_with(PixelwiseMask(initial=heights), budget.fidelity)
        made.append(optics)
        return optics

    bound = depth_limit(make())
    scores = trained_scores(make, "depth", budget, seed, **({} if scale in ("smoke", "cpu") else MIDAS))
    return {**scores, "start_bound": bound, "closed_bound": depth_limit(made[-1])}


MIDAS = {"head": "midas-small", "width": None}


def table(rows: Sequence[Row], scale: str) -> str:
    """Return the table of starts."""
    lines = []
    for start in dict.fromkeys(row["start"] for row in rows):
        own = [row for row in rows if row["start"] == start]
        bounds = [mean_and_error(found) if (found := means(own, name)) else "-" for name in BOUNDS]
        lines.append([start, str(len(own)), *cells(own, "depth"), *bounds, f"{PAPER.get(start, '-')}"])
    heading = [
        "start", "seeds", "network", "closed form, masks learnt", "closed form, masks at the start",
        "bound, learnt", "bound, start", "the paper",
    ]  # fmt: skip
    return f"{UNITS}\n\n{grid(heading, lines)}\n\n{JUDGED}"


BOUNDS = ("closed_bound", "start_bound")
UNITS = """\
RMSE of normalised inverse depth in parts of the range, in brackets times 20, PhaseCam3D's scale; painted scenes / real
scenes; mean ± standard error over seeds. The bound is that of a point with the light of a white pixel."""
JUDGED = """\
Judged can be how much the first masks tell of a bright point's depth, by the bound, and how far training moved that.
A row whose network is no better than the mean depth of the training scenes has learnt nothing of depth, and its order
among others means nothing; the same goes for the closed form. Not judged can be the paper's ranking, which is that of
one run each of a pretrained MiDaS Small after 200 epochs, without error bars; its weights are not on this machine, and
U-Nets with random weights stand in for it."""


def draw(rows: Sequence[Row], path: Path) -> None:
    """Draw the RMSE of network and closed form and the bound, for each start."""
    series = {}
    for name, words in (("network_painted_rmse", "network"), ("closed_painted_rmse", "closed form"),
                        ("start_bound", "bound, first masks")):  # fmt: skip
        kept = [row for row in rows if row["start"] != CONSTANT]
        starts = dict.fromkeys(row["start"] for row in kept)
        series[words] = {start: means([row for row in kept if row["start"] == start], name) for start in starts}
    bars({"depth, RMSE in parts of the range": series}, path, "masks at the start")


def settings(scale: str) -> str:
    """Return what the results depend on."""
    return f"Budget of each row: {BUDGETS[scale].words}. Paper: 200 epochs of 5,077 scenes."


EXPERIMENT = Experiment("initialisation", "4. The first masks for depth", trials, measure, table, settings, draw)

if __name__ == "__main__":
    sys.exit(not main(EXPERIMENT, __doc__ or ""))
