"""Experiment 7, switching time: systems trained for instant swaps of masks, scored where a swap takes 1 to 16 ms.

    python -m examples.paper.switching_time --scale smoke
    python -m examples.paper.switching_time --scale cpu

The exposure lasts 100 ms. During a swap the modulator shows a random pattern, the paper's worst case, or a relaxing
liquid crystal. The systems are those that come with the package, and are not trained further.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from examples.paper.report import bars, cell, grid, means
from examples.paper.runner import Experiment, Row, Trial, main
from examples.paper.shipped import conditions, shipped_scores
from kornia_tidy import DwellTimes, Switching

SYSTEMS = ("joint-5", "joint-1", "edof-5", "edof-1")
TIMES = {"smoke": ("0", "16"), "cpu": ("0", "1", "4", "16")}  # ms
FINE = ("0", "1", "2", "4", "8", "16")
BETWEEN = ("random", "exponential")


def trials(scale: str) -> list[Trial]:
    """Return the trials: systems by time of a swap. A system of one mask has no swaps, and a single trial."""
    times = TIMES.get(scale, FINE)
    found = [{"system": name, "between": "random", "time": time} for name in SYSTEMS for time in times]
    found += [{"system": "joint-5", "between": "exponential", "time": time} for time in times]
    kept = [trial for trial in found if trial["time"] == "0" or not trial["system"].endswith("-1")]
    instant = {"between": "exponential", "time": "0"}  # the same capture as with random states
    kept = [trial for trial in kept if not instant.items() <= trial.items()]
    return kept[:2] if scale == "smoke" else kept


def measure(trial: Trial, scale: str) -> Mapping[str, float | str]:
    """Return the scores of network and closed form at a time of a swap."""
    seconds = float(trial["time"]) / 1000
    modulator = Switching(seconds, between=trial["between"]) if seconds else DwellTimes()
    return shipped_scores(trial["system"], scale, modulator=modulator)


def table(rows: Sequence[Row], scale: str) -> str:
    """Return the table of systems and times."""
    lines = [
        [
            row["system"], row["between"] if row["time"] != "0" else "-", f"{row['time']} ms", share(row),
            cell([row], "network", row["task"]), cell([row], "closed", row["task"]),
        ]
        for row in rows
    ]  # fmt: skip
    heading = ["system", "states between", "a swap", "of the exposure", "network", "closed form told of it"]
    return f"{UNITS}\n\n{grid(heading, lines)}\n\n{JUDGED}"


def share(row: Row) -> str:
    """Return the share of an exposure of 100 ms in which masks are swapped."""
    swaps = int(row["system"].rsplit("-", 1)[1]) - 1
    return f"{swaps * float(row['time']):g} %"


def draw(rows: Sequence[Row], path: Path) -> None:
    """Draw the networks' scores over the time of a swap; systems of one mask at every time, as they have no swaps."""
    panels: dict[str, dict[str, dict[str, list[float]]]] = {}
    times = sorted({row["time"] for row in rows}, key=float)
    scores = {"depth RMSE, painted": "network_painted_rmse", "image PSNR in dB, painted": "network_painted_psnr"}
    for heading, score in scores.items():
        task = "joint" if score.endswith("rmse") else "edof"
        series = {}
        for name in (f"{task}-5", f"{task}-1"):
            some = [row for row in rows if row["system"] == name and row["between"] == "random"]
            wanted = {time: "0" if name.endswith("-1") else time for time in times}  # one mask has no swaps
            series[name] = {time: means([r for r in some if r["time"] == wanted[time]], score) for time in times}
        if any(points for by_time in series.values() for points in by_time.values()):
            panels[heading] = series
    bars(panels, path, "ms for a swap")


UNITS = """\
Painted scenes / real scenes: PSNR in dB of images, RMSE of normalised inverse depth in parts of the range (times 20).
A system of five masks has four swaps in its exposure of 100 ms; one of one mask has none."""
JUDGED = """\
Judged can be what swaps cost these systems as they are, and from when on one mask is ahead of five. Not judged can be
what training with swaps wins back: that is experiment 7b. For masks alone, without a network,
`examples/learn_with_switching.py` measures it."""


def settings(scale: str) -> str:
    """Return what the results depend on."""
    return f"{conditions(scale)} Random states are those of seed 0."


EXPERIMENT = Experiment("switching_time", "7. Switching time", trials, measure, table, settings, draw)

if __name__ == "__main__":
    sys.exit(not main(EXPERIMENT, __doc__ or ""))
