"""Experiment 7, the time between masks: what does it cost a system that was trained for instant changes?

    python -m examples.paper.switching --scale smoke
    python -m examples.paper.switching --scale cpu

A change from one mask to the next takes 1 to 16 ms of an exposure of 100 ms. Between stand random patterns, as in the
paper, or the states of a liquid crystal that relaxes. The systems are those that come with the package, which were not
trained for it; their networks and closed forms know the PSFs with the states between.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from examples.paper.cameras import F_NUMBER
from examples.paper.closed_forms import ClosedForms
from examples.paper.report import grid
from examples.paper.runner import Experiment, Row, Trial, main
from examples.paper.scenes import Budget, painted, real
from examples.paper.training import mean_scores, prefixed, system_of
from kornia_tidy import Switching
from kornia_tidy.inference.pretrained import load_pretrained
from kornia_tidy.sensor.exposure import exposed_sensor

ELECTRONS, EXPOSURE = 57_000.0, 0.1  # of white at f/17.6; s
TIMES = ("0", "1", "2", "4", "8", "16")  # ms
SYSTEMS = {5: "edof-5", 1: "edof-1"}
SIZES = {"smoke": (128, 1, 0), "cpu": (192, 8, 12), "gpu": (256, 64, 35), "paper": (256, 419, 35)}
"""Side of the scenes in pixels, and the numbers of painted and of real ones, by scale."""


def trials(scale: str) -> list[Trial]:
    """Return the trials: numbers of masks, states between, and times."""
    changes = [
        {"masks": "5", "between": between, "ms": ms} for between in ("random", "exponential") for ms in TIMES[1:]
    ]
    still = [{"masks": str(count), "between": "-", "ms": "0"} for count in SYSTEMS]
    return [*still, *(changes[:1] if scale == "smoke" else changes)]


def measure(trial: Trial, scale: str) -> Mapping[str, float | str]:
    """Return the scores of a shipped system whose masks change in a given time."""
    shipped = load_pretrained(SYSTEMS[int(trial["masks"])])
    optics = shipped.optics
    optics.sensor = exposed_sensor(optics.camera.f_number, ELECTRONS, F_NUMBER)
    if trial["ms"] != "0":
        optics.modulator = Switching(1e-3 * float(trial["ms"]), EXPOSURE, between=trial["between"])
    network = system_of(optics, shipped.head, shipped.settings, shipped.step)
    closed = system_of(optics, ClosedForms(optics, "edof"), shipped.settings, 0)
    size, count, most = SIZES[scale]
    sets = {"painted": painted(Budget(size=size), "test", count), "real": real(most, size)}
    found: dict[str, float | str] = {}
    for where, scenes in sets.items():
        for what, system in (("network", network), ("closed", closed)):
            found |= prefixed(what, {f"{where}_{name}": value for name, value in mean_scores(system, scenes).items()})
    return found


def table(rows: Sequence[Row], scale: str) -> str:
    """Return PSNR over the time of a change."""
    lines = []
    for row in rows:
        share = 4 * float(row["ms"]) / (1e3 * EXPOSURE) if row["masks"] == "5" else 0.0
        scores = [
            " / ".join(
                f"{float(row[name]):.2f}" for name in (f"{what}_painted_psnr", f"{what}_real_psnr") if name in row
            )
            for what in ("network", "closed")
        ]
        lines.append([row["masks"], row["between"], row["ms"], f"{share:.0%}", *scores])
    heading = ["masks", "between", "ms", "of the exposure", "network", "closed form"]
    return f"All in focus, PSNR in dB, painted / real scenes:\n\n{grid(heading, lines)}\n\n{JUDGED}"


JUDGED = """\
Judged can be what the states between cost without retraining, as in the paper, for images. Not judged can be depth,
2 to 4 masks, for which no system is shipped, and training with switching on: for masks without a network that is
`examples/learn_with_switching.py`."""


def draw(rows: Sequence[Row], path: Path) -> None:
    """Draw the network's PSNR over the time of a change."""
    where = "real" if any("network_real_psnr" in row for row in rows) else "painted"
    score, figure = f"network_{where}_psnr", Figure(figsize=(6, 4), layout="constrained")
    axes = figure.subplots()
    start = next(row for row in rows if row["masks"] == "5" and row["ms"] == "0")
    for between in ("random", "exponential"):
        own = [start, *(row for row in rows if row["between"] == between)]
        axes.plot(
            [float(row["ms"]) for row in own], [float(row[score]) for row in own], "o-", label=f"5 masks, {between}"
        )
    single = next(row for row in rows if row["masks"] == "1")
    axes.axhline(float(single[score]), color="grey", linestyle="--", label="1 mask")
    axes.set(xlabel="time of a change, ms of an exposure of 100 ms", ylabel=f"PSNR, {where} scenes, dB")
    axes.legend(frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=110)


def settings(scale: str) -> str:
    """Return what the results depend on."""
    size, count, most = SIZES[scale]
    return (
        f"{', '.join(SYSTEMS.values())} as shipped; {count} painted and {most} real scenes of {size} px, {ELECTRONS:g} "
        f"electrons of white at f/{F_NUMBER}."
    )


EXPERIMENT = Experiment("switching", "7. The time between masks", trials, measure, table, settings, draw)

if __name__ == "__main__":
    sys.exit(not main(EXPERIMENT, __doc__ or ""))
