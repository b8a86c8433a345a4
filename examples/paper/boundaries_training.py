"""Experiment 9b, training with occlusion: systems trained further on occlusion-aware captures, and on gather.

    python -m examples.paper.boundaries_training --scale smoke
    python -m examples.paper.boundaries_training --scale cpu        twenty minutes

Masks and network of the shipped systems go on learning with one compositing of the captures. Both are scored on both,
so that the reverse of experiment 9 is measured as well: trained with occlusion, scored on gather.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence

from examples.paper.runner import Experiment, Row, Trial, main
from examples.paper.trained_further import crossed_scores, crossed_table, further_conditions, further_trials

CONDITIONS = {name: {"compositing": name} for name in ("gather", "occlusion")}
SYSTEMS = ("joint-5", "joint-1")


def trials(scale: str) -> list[Trial]:
    """Return the trials: systems as shipped, then by the compositing of the training, and by seed."""
    if scale == "smoke":
        return further_trials({"joint-1": ("occlusion",)}, scale)
    return further_trials(dict.fromkeys(SYSTEMS, tuple(CONDITIONS)), scale)


def measure(trial: Trial, scale: str) -> Mapping[str, float | str]:
    """Return the scores of network and closed form with each compositing."""
    return crossed_scores(trial, scale, CONDITIONS, tuple(CONDITIONS))


def table(rows: Sequence[Row], scale: str) -> str:
    """Return the tables of networks and closed forms."""
    network, closed = (crossed_table(rows, tuple(CONDITIONS), what) for what in ("network", "closed"))
    return f"{UNITS}\n\n**Network:**\n\n{network}\n\n**Closed form:**\n\n{closed}\n\n{JUDGED}"


UNITS = """\
Painted scenes / real scenes: PSNR in dB of images, RMSE of normalised inverse depth in parts of the range (times 20),
mean ± standard error over seeds. The columns are the compositing of the captures that are scored. *As shipped* was
trained on gather, and not further."""
JUDGED = """\
Judged can be what training on one compositing costs on the other: compare rows of one system, in which the steps are
the same. Not judged can be systems trained with occlusion from the start, to convergence. Behind a near surface the
scenes have no pixels, so that occlusion-aware compositing extends what is visible."""


def settings(scale: str) -> str:
    """Return what the results depend on."""
    return further_conditions(scale)


EXPERIMENT = Experiment("boundaries_training", "9b. Training with occlusion", trials, measure, table, settings)

if __name__ == "__main__":
    sys.exit(not main(EXPERIMENT, __doc__ or ""))
