"""Experiment 1, theorem 1: averages of PSFs that no single mask makes, and how far from them a single mask stays.

    python -m examples.paper.theorem --scale smoke
    python -m examples.paper.theorem --scale cpu        some minutes

- **Witness.** Only two points of the aperture are as far apart as they are. At their difference the autocorrelation of
  the pupil has the modulus 1 for every single mask, and the mean of K unit phasors for an average over K masks.
- **Reach.** The averaged PSFs of five random masks are the target. Sequences of 1 to 5 masks are optimised towards it
  from many random starts; what the best of them misses is the residual, in parts of the target's own energy. Five masks
  can make the target exactly: what they miss is how far the search falls short of what exists.

Source: Shah et al., TiDy-PSFs (ICCV 2023), theorem 1.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch
from matplotlib.figure import Figure

from examples.paper.report import grid
from examples.paper.runner import Experiment, Row, Trial, main
from examples.paper.sequences import PSI, RULE, first_phase, learn, psfs_of
from kornia_tidy import PixelwiseMask
from kornia_tidy.mask_design.non_convexity import autocorrelation_bound
from kornia_tidy.optics.aperture import circular_aperture

SETS = {"smoke": 20, "cpu": 1000, "gpu": 1000, "paper": 1000}  # of masks, for each witness
TARGETS = {"smoke": 1, "cpu": 3, "gpu": 10, "paper": 10}
RESTARTS = {"smoke": 4, "cpu": 40, "gpu": 400, "paper": 400}
STEPS = {"smoke": 30, "cpu": 2000, "gpu": 2000, "paper": 2000}  # at most
DEPTHS = {"one depth": torch.zeros(1), "21 depths": PSI}
LENGTHS = {"smoke": (1, 5), "cpu": (1, 2, 3, 5), "gpu": (1, 2, 3, 4, 5), "paper": (1, 2, 3, 4, 5)}
WITNESS = "witness"
TOGETHER = 20  # starts in a batch


def trials(scale: str) -> list[Trial]:
    """Return the trials: witnesses of each number of masks, then targets, depths and lengths."""
    witnesses = [{"what": WITNESS, "masks": str(count), "target": "-"} for count in (1, 2, 3, 4, 5, 8, 16)]
    reached = [
        {"what": depths, "masks": str(length), "target": str(target)}
        for target in range(TARGETS[scale])
        for depths in DEPTHS
        for length in LENGTHS[scale]
    ]
    return [*witnesses, *reached]


def measure(trial: Trial, scale: str) -> Mapping[str, float | str]:
    """Return the witnesses of random masks, or what the best and the median start miss of a target."""
    count = int(trial["masks"])
    if trial["what"] == WITNESS:
        noise, aperture = torch.Generator().manual_seed(count), circular_aperture(23)
        sets = [PixelwiseMask(count, generator=noise).phase.detach() for _ in range(SETS[scale])]
        values = torch.stack([autocorrelation_bound(phase, aperture) for phase in sets])
        return {
            "least": float(values.min()),
            "middle": float(values.square().mean().sqrt()),
            "most": float(values.max()),
        }
    psi = DEPTHS[trial["what"]]
    hidden = first_phase(5, [10**6 + int(trial["target"])])[0]
    wanted = psfs_of(hidden, psi=psi)
    missed = []
    for first in range(0, RESTARTS[scale], TOGETHER):
        seeds = range(first, min(first + TOGETHER, RESTARTS[scale]))
        missed.append(learn(first_phase(count, seeds), STEPS[scale], wanted, psi).after)
    shares = (torch.cat(missed) / wanted.square().mean()).sqrt().sort().values
    return {"least": float(shares[0]), "middle": float(shares.median()), "most": float(shares[-1])}


def table(rows: Sequence[Row], scale: str) -> str:
    """Return a table of the witnesses and one of what is missed."""
    witnesses = [row for row in rows if row["what"] == WITNESS]
    lines = [
        [
            row["masks"],
            *(f"{float(row[name]):.6f}" for name in ("least", "middle", "most")),
            f"{int(row['masks']) ** -0.5:.3f}",
        ]
        for row in witnesses
    ]
    parts = [
        f"Witness of {SETS[scale]} random sets of masks; below 1, no single mask makes the average:",
        grid(["masks", "least", "root mean square", "largest", "random phasors"], lines),
    ]
    for depths in DEPTHS:
        lines = []
        for length in LENGTHS[scale]:
            own = [row for row in rows if row["what"] == depths and row["masks"] == str(length)]
            if own:
                least = [float(row["least"]) for row in own]
                middle = sum(float(row["middle"]) for row in own) / len(own)
                lines.append([
                    str(length), str(len(own)), f"{sum(least) / len(least):.4f}",
                    f"{min(least):.4f} to {max(least):.4f}", f"{middle:.4f}",
                ])  # fmt: skip
        parts += [
            f"Missed of the average of five random masks, {depths}, root mean square over that of the target, "
            f"{RESTARTS[scale]} starts:",
            grid(["masks", "targets", "best start, mean", "best start, range", "median start, mean"], lines),
        ]
    return "\n\n".join([*parts, JUDGED])


JUDGED = """\
Judged can be the witness, which is exact up to rounding. Not judged can be what the best possible single mask misses:
the search finds local minima. How far it falls short of what exists is seen in the rows of five masks, which can make
the target exactly."""


def draw(rows: Sequence[Row], path: Path) -> None:
    """Draw witnesses and residuals over the number of masks."""
    figure = Figure(figsize=(11, 4.2), layout="constrained")
    witness, reach = figure.subplots(1, 2)
    own = [row for row in rows if row["what"] == WITNESS]
    counts = [int(row["masks"]) for row in own]
    witness.fill_between(counts, [float(row["least"]) for row in own], [float(row["most"]) for row in own], alpha=0.2)
    witness.plot(counts, [float(row["middle"]) for row in own], "o-", label="root mean square, and range")
    witness.axhline(1, color="C3", linewidth=1, label="every single mask")
    witness.set(xlabel="masks in the average", ylabel=r"witness $|(X \star X)_{v-u}|$", ylim=(0, 1.05))
    witness.legend(frameon=False)
    for colour, depths in enumerate(DEPTHS):
        lines = [row for row in rows if row["what"] == depths]
        for target in sorted({row["target"] for row in lines}):
            of_target = [row for row in lines if row["target"] == target]
            label = depths if target == "0" else None
            places, least = zip(*((int(row["masks"]), float(row["least"])) for row in of_target), strict=True)
            reach.plot(places, least, "o-", color=f"C{colour}", alpha=0.6, label=label)
    reach.set(xlabel="masks that are optimised", ylabel="missed by the best start", ylim=(0, None))
    reach.legend(frameon=False)
    for axes in (witness, reach):
        axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=110)


def settings(scale: str) -> str:
    """Return what the results depend on."""
    return (
        f"{RULE}; at most {STEPS[scale]} steps; {TARGETS[scale]} targets, {RESTARTS[scale]} starts, {SETS[scale]} sets "
        f"for each witness."
    )


EXPERIMENT = Experiment("theorem", "1. Theorem 1", trials, measure, table, settings, draw)

if __name__ == "__main__":
    sys.exit(not main(EXPERIMENT, __doc__ or ""))
