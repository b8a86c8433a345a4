"""Experiment 9, boundaries: systems trained on captures by gather, scored on occlusion-aware ones.

    python -m examples.paper.boundaries --scale smoke
    python -m examples.paper.boundaries --scale cpu

The paper blurs each pixel by the PSF of its own depth (gather), so that blur does not cross from a near surface over a
far one as it does in a lens. Occlusion-aware compositing is nearer to the lens. The systems are those that come with
the package, which were trained on gather.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence

from examples.paper.report import cell, grid
from examples.paper.runner import Experiment, Row, Trial, main
from examples.paper.shipped import conditions, shipped_scores

SYSTEMS = ("joint-5", "joint-1", "edof-5", "edof-1")
COMPOSITING = ("gather", "occlusion")


def trials(scale: str) -> list[Trial]:
    """Return the trials: systems by the compositing of their captures."""
    names = SYSTEMS[:1] if scale == "smoke" else SYSTEMS
    return [{"system": name, "compositing": how} for name in names for how in COMPOSITING]


def measure(trial: Trial, scale: str) -> Mapping[str, float | str]:
    """Return the scores of network and closed form."""
    return shipped_scores(trial["system"], scale, compositing=trial["compositing"])


def table(rows: Sequence[Row], scale: str) -> str:
    """Return the table of systems and compositing."""
    lines = [
        [row["system"], row["compositing"], cell([row], "network", row["task"]), cell([row], "closed", row["task"])]
        for row in rows
    ]
    return f"{UNITS}\n\n{grid(['system', 'captures by', 'network', 'closed form'], lines)}\n\n{JUDGED}"


UNITS = """\
Painted scenes / real scenes: PSNR in dB of images, RMSE of normalised inverse depth in parts of the range (times 20).
All networks were trained on gather. The closed form assumes one depth in each neighbourhood."""
JUDGED = """\
Judged can be what a system trained on gather loses on captures with occlusion. Not judged can be the reverse, training
with occlusion and scoring on gather: that is experiment 9b. Behind a near surface the scenes have no pixels, so that
occlusion-aware compositing extends what is visible."""


def settings(scale: str) -> str:
    """Return what the results depend on."""
    return conditions(scale)


EXPERIMENT = Experiment("boundaries", "9. Boundaries of depth", trials, measure, table, settings)

if __name__ == "__main__":
    sys.exit(not main(EXPERIMENT, __doc__ or ""))
