"""Experiment 7b, training with switching: systems trained further with slow swaps of masks, scored with slow swaps.

    python -m examples.paper.switching_training --scale smoke
    python -m examples.paper.switching_training --scale cpu        fifteen minutes

The paper trains for instant swaps and leaves this open. Masks and network of the shipped systems go on learning while a
swap takes 0, 1 or 4 ms of an exposure of 100 ms. The modulator shows a random pattern meanwhile, another in each step
of the training. The scores are those of patterns that no training has seen.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from examples.paper.report import bars, means
from examples.paper.runner import Experiment, Row, Trial, main
from examples.paper.trained_further import crossed_scores, crossed_table, further_conditions, further_trials
from kornia_tidy import DwellTimes, Switching, TiDyOptics

SYSTEMS = {"joint-5": ("0 ms", "1 ms", "4 ms"), "joint-1": ("0 ms",)}  # one mask has no swaps
SWAPS = {"0 ms": DwellTimes(), **{f"{t} ms": Switching(t / 1000, between="random") for t in (1, 4, 16)}}
SCORED = {"smoke": ("0 ms", "4 ms")}
CONDITIONS = {name: {"modulator": modulator} for name, modulator in SWAPS.items()}


def trials(scale: str) -> list[Trial]:
    """Return the trials: systems as shipped, then by the time of a swap in training, and by seed."""
    return further_trials({"joint-5": ("4 ms",)} if scale == "smoke" else SYSTEMS, scale)


def measure(trial: Trial, scale: str) -> Mapping[str, float | str]:
    """Return the scores of network and closed form at each time of a swap."""
    return crossed_scores(trial, scale, CONDITIONS, SCORED.get(scale, tuple(SWAPS)), other_patterns)


def other_patterns(optics: TiDyOptics, step: int) -> None:
    """Draw new random patterns before a step; those of seed 0 are kept for the scores."""
    if isinstance(optics.modulator, Switching):
        optics.modulator = Switching(optics.modulator.switching_time, between="random", seed=1 + step)


def table(rows: Sequence[Row], scale: str) -> str:
    """Return the tables of networks and closed forms."""
    scored = SCORED.get(scale, tuple(SWAPS))
    network, closed = (crossed_table(rows, scored, what) for what in ("network", "closed"))
    return f"{UNITS}\n\n**Network:**\n\n{network}\n\n**Closed form, told of the swaps:**\n\n{closed}\n\n{JUDGED}"


def draw(rows: Sequence[Row], path: Path) -> None:
    """Draw the networks' scores over the time of a swap, for five masks trained without and with swaps, and for one."""
    kinds = {("joint-5", "0 ms"): "5 masks, trained at 0 ms", ("joint-5", "4 ms"): "5 masks, trained at 4 ms",
             ("joint-1", "0 ms"): "1 mask"}  # fmt: skip
    panels = {}
    for score, heading in (("rmse", "depth RMSE, painted"), ("psnr", "image PSNR in dB, painted")):
        series = {}
        for (name, trained), words in kinds.items():
            own = [row for row in rows if (row["system"], row["trained"]) == (name, trained)]
            series[words] = {time: means(own, f"network_{time}_painted_{score}") for time in SWAPS}
        panels[heading] = series
    bars(panels, path, "a swap in the scored captures")


UNITS = """\
Painted scenes / real scenes: PSNR in dB of images, RMSE of normalised inverse depth in parts of the range (times 20),
mean ± standard error over seeds. The columns are the times of a swap in the captures that are scored; five masks have
four swaps. *As shipped* was not trained further."""
JUDGED = """\
Judged can be what training with swaps wins back for systems that were trained without: compare rows of one system, in
which the steps are the same. Where the states between are random they do not depend on the masks, so that most of it
is the network's. Not judged can be systems trained with swaps from the start, to convergence, and those of two to four
masks, which are not shipped."""


def settings(scale: str) -> str:
    """Return what the results depend on."""
    return f"{further_conditions(scale)} Random states of the training change with each step; those scored have seed 0."


EXPERIMENT = Experiment("switching_training", "7b. Training with switching", trials, measure, table, settings, draw)

if __name__ == "__main__":
    sys.exit(not main(EXPERIMENT, __doc__ or ""))
