"""Experiment 1, the theorem: averages of PSFs that no single mask has, and how near to them a single mask comes.

    python -m examples.paper.theorem --scale smoke
    python -m examples.paper.theorem --scale cpu

A target is the PSF of one mask or the average PSF of five. Single masks and sequences of five are fitted to it from
many random starts, by gradient descent on the squared difference of the PSFs. The theorem says that a single mask
cannot have the average; its proof also bounds the difference from below, which is the column "bound".
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from examples.paper.report import bars, grid, mean_and_error, means
from examples.paper.runner import Experiment, Row, Trial, main
from kornia_tidy.design.non_convexity import autocorrelation_bound
from kornia_tidy.optics.aperture import circular_aperture
from kornia_tidy.psf.pupil import pupil_field
from kornia_tidy.seeds import keyed_seed

SIDE, PADDED = 23, 48  # pixels of the mask, and of its transform, which holds every lag of the autocorrelation
SWEEP = (-10.0, -5.0, 0.0, 5.0, 10.0)  # rad at the edge of the pupil
TARGETS = ("one random mask", "five random masks", "focal sweep")
EXTENT = {"smoke": (4, 20, 1), "cpu": (16, 300, 3), "gpu": (256, 2000, 5), "paper": (256, 2000, 5)}
"""Random starts, steps of each, and seeds of the target, by scale."""


def trials(scale: str) -> list[Trial]:
    """Return the trials: targets, and the number of masks fitted to each."""
    seeds = EXTENT[scale][2]
    return [
        {"target": target, "fitted": fitted, "seed": str(seed)}
        for seed in range(seeds)
        for target in TARGETS
        for fitted in ("1", "5")
    ]


def measure(trial: Trial, scale: str) -> Mapping[str, float | str]:
    """Return the smallest and the median residual over the starts, and the bounds of the theorem."""
    starts, steps, _ = EXTENT[scale]
    aperture = circular_aperture(SIDE)
    masks = target_masks(trial["target"], int(trial["seed"]))
    target = average_psf(masks, aperture)
    seed = keyed_seed("paper", "theorem", trial["target"], trial["fitted"], trial["seed"])
    residuals = fit(target, aperture, starts, int(trial["fitted"]), steps, torch.Generator().manual_seed(seed))
    bound = float(autocorrelation_bound(masks, aperture))
    return {
        "best": float(residuals.min()),
        "median": float(residuals.median()),
        "autocorrelation": bound,
        "bound": least_residual(bound, target, aperture),
    }


def target_masks(target: str, seed: int) -> Tensor:
    """Return the masks of a target, in radians, (K, N, N)."""
    if target == "focal sweep":
        line = torch.linspace(-1.1, 1.1, SIDE)
        return torch.tensor(SWEEP)[:, None, None] * (line.square()[:, None] + line.square())
    noise = torch.Generator().manual_seed(keyed_seed("paper", "target", seed))
    return 2 * math.pi * torch.rand(1 if target.startswith("one") else 5, SIDE, SIDE, generator=noise)


def average_psf(phase: Tensor, aperture: Tensor) -> Tensor:
    """Return the average PSF of masks (..., K, N, N), with sum one."""
    field = pupil_field(phase, aperture.to(phase), 1.0)
    return torch.fft.fft2(field, s=(PADDED, PADDED), norm="ortho").abs().square().mean(-3) / aperture.sum()


def fit(target: Tensor, aperture: Tensor, starts: int, masks: int, steps: int, noise: torch.Generator) -> Tensor:
    """Return the residual of each start: the norm of the difference of the PSFs over the norm of the target.

    All starts are fitted as one batch; they do not influence each other.
    """
    phase = (2 * math.pi * torch.rand(starts, masks, SIDE, SIDE, generator=noise)).requires_grad_()
    optimizer = torch.optim.Adam([phase], lr=0.1)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    scale = target.square().sum()
    for _ in range(steps):
        optimizer.zero_grad()
        difference = average_psf(phase, aperture) - target
        (difference.square().sum((-2, -1)) / scale).sum().backward()
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        return ((average_psf(phase, aperture) - target).square().sum((-2, -1)) / scale).sqrt()


def least_residual(bound: float, target: Tensor, aperture: Tensor) -> float:
    """Return a residual that every single mask exceeds, by the autocorrelation at the two extreme lags.

    Args:
        bound: modulus of the target's autocorrelation at the extreme lag, where that of a single mask is 1.
        target: PSF with sum one.
        aperture: binary, (N, N).
    """
    difference = 2 * ((1 - bound) / float(aperture.sum())) ** 2  # of the transforms, at the lag and at its opposite
    return (difference / (PADDED**2 * float(target.square().sum()))) ** 0.5


def table(rows: Sequence[Row], scale: str) -> str:
    """Return the table of residuals."""
    lines = []
    for target in TARGETS:
        for fitted in ("1", "5"):
            some = [row for row in rows if (row["target"], row["fitted"]) == (target, fitted)]
            if some:
                scores = [percent(means(some, name)) for name in ("best", "median", "bound")]
                bound = scores[2] if fitted == "1" else "-"
                lines.append([target, fitted, *scores[:2], bound, mean_and_error(means(some, "autocorrelation"))])
    heading = ["target", "masks fitted", "best residual", "median residual", "bound", "autocorrelation of the target"]
    return f"{UNITS.format(starts=EXTENT[scale][0])}\n\n{grid(heading, lines)}\n\n{JUDGED}"


def percent(values: Sequence[float]) -> str:
    """Return the mean of fractions in percent, with its standard error, as text."""
    return mean_and_error([100 * value for value in values]) + " %"


def draw(rows: Sequence[Row], path: Path) -> None:
    """Draw the best residual of one mask and of five, for each target."""
    series = {
        f"{fitted} fitted": {
            target: means([r for r in rows if (r["target"], r["fitted"]) == (target, fitted)], "best")
            for target in TARGETS
        }
        for fitted in ("1", "5")
    }
    bars({"residual of the best start": series}, path, "target")


UNITS = """\
Residual: norm of the difference of the PSFs over the norm of the target, of the best and of the median of {starts}
random starts. The autocorrelation at the extreme lag is 1 for every single mask; below 1 no single mask has the PSF.
The focal sweep has 1 there as well, since defocus is the same at opposite edges: this lag says nothing of it."""
JUDGED = """\
Judged can be the theorem itself: an autocorrelation below 1 is a proof for that target. The proven bound is far below
what the starts reach. Not judged can be whether a still better single mask exists between the two: gradient descent
finds no certified optimum, and it does not always return to a target that a single mask has (first row)."""


def settings(scale: str) -> str:
    """Return what the results depend on."""
    starts, steps, seeds = EXTENT[scale]
    return (
        f"{starts} starts of {steps} Adam steps (rate 0.1 rad, cosine), {seeds} targets of each kind, masks of {SIDE} "
        f"px, PSFs of {PADDED} px at one wavelength and in focus, without noise."
    )


EXPERIMENT = Experiment(
    "theorem", "1. Non-convexity, and the reach of averages", trials, measure, table, settings, draw
)

if __name__ == "__main__":
    sys.exit(not main(EXPERIMENT, __doc__ or ""))
