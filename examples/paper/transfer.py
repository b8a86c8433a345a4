"""Experiment 6, transfer: systems that were trained on painted scenes, scored on real ones without fine-tuning.

    python -m examples.paper.transfer --scale smoke
    python -m examples.paper.transfer --scale cpu

The systems are those that come with the package. None of them was trained on any of these scenes. NYU Depth v2 is
scored where ``data/nyu`` holds its labelled file, see docs/data_sets.md.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from examples.paper.cameras import F_NUMBER
from examples.paper.closed_forms import ClosedForms
from examples.paper.report import cell, grid, means
from examples.paper.runner import Experiment, Row, Trial, main
from examples.paper.scenes import Budget, painted, real
from examples.paper.shipped import load_shipped
from examples.paper.training import best_temperature, mean_scores, prefixed, system_of
from kornia_tidy.sensor.exposure import exposed_sensor

TRAINED = ("joint-5", "joint-1", "joint-0", "edof-5", "edof-1", "edof-0", "edof-designed", "edof-flat")
ELECTRONS = 57_000.0  # at f/17.6: a noise of 0.002 at a fifth of full scale, in which the systems were trained
NYU = Path("data/nyu")
PAPER = {"joint-5": "0.019 / 0.175", "joint-1": "0.026 / 0.259"}
"""Depth RMSE of TiDy (5) and (1) in TiDy-PSFs, table 2: FlyingThings3D / NYU Depth v2, without fine-tuning."""
SIZES = {"smoke": (96, 2, 0), "cpu": (160, 16, 12), "gpu": (256, 64, 35), "paper": (256, 419, 35)}
"""Side of the scenes in pixels, and the numbers of painted and of real ones, by scale."""


def trials(scale: str) -> list[Trial]:
    """Return the trials: shipped systems."""
    names = ("edof-5", "joint-5") if scale == "smoke" else TRAINED
    return [{"system": name} for name in names]


def measure(trial: Trial, scale: str) -> Mapping[str, float | str]:
    """Return the scores of a shipped system's network and of the closed form, on each set of scenes."""
    shipped = load_shipped(trial["system"])
    optics, task = shipped.optics, shipped.settings.task
    optics.sensor = exposed_sensor(optics.camera.f_number, ELECTRONS, F_NUMBER)
    network = system_of(optics, shipped.head, shipped.settings, shipped.step)
    closed = system_of(optics, ClosedForms(optics, task), shipped.settings, 0)
    if task != "edof":
        best_temperature(closed, painted(budget_of(scale), "validation", min(8, SIZES[scale][1])))
    found: dict[str, float | str] = {"task": task, "f_number": optics.camera.f_number, "steps": float(shipped.step)}
    for where, scenes in scene_sets(scale).items():
        for what, system in (("network", network), ("closed", closed)):
            found |= prefixed(what, {f"{where}_{name}": value for name, value in mean_scores(system, scenes).items()})
    return found


def budget_of(scale: str) -> Budget:
    """Return the budget with the sizes of this experiment."""
    return Budget(size=SIZES[scale][0])


def scene_sets(scale: str) -> dict[str, Any]:
    """Return the sets of scenes by name; real ones and NYU where their files are on this machine."""
    size, count, most = SIZES[scale]
    sets: dict[str, Any] = {"painted": painted(budget_of(scale), "test", count), "real": real(most, size)}
    if NYU.exists() and scale != "smoke":
        from kornia_tidy.training.data_sets import make_scenes  # noqa: PLC0415
        from kornia_tidy.training.settings import TrainingSettings  # noqa: PLC0415

        sets["nyu"] = make_scenes(TrainingSettings(data="nyu", root=str(NYU), size=size), "test", 64)
    return sets


def table(rows: Sequence[Row], scale: str) -> str:
    """Return the table of the systems."""
    lines = []
    for row in rows:
        nyu = means([row], "network_nyu_rmse") or means([row], "network_nyu_psnr")
        lines.append([
            row["system"], f"f/{float(row['f_number']):.3g}", cell([row], "network", row["task"]),
            cell([row], "closed", row["task"]), f"{nyu[0]:.3g}" if nyu else "not run", PAPER.get(row["system"], "-"),
        ])  # fmt: skip
    heading = ["system", "lens", "network", "closed form", "network, NYU Depth v2", "the paper, depth, NYU"]
    return f"{UNITS}\n\n{grid(heading, lines)}\n\n{JUDGED}"


UNITS = """\
Painted scenes / real scenes: PSNR in dB of images, RMSE of normalised inverse depth in parts of the range (times 20).
The number behind the name is that of the masks; `-0` is a Fresnel lens, `edof-flat` the lens without masks at f/48,
`edof-designed` five masks at f/24. The exposure time is the same for all."""
JUDGED = """\
Judged can be what these systems lose between painted and real scenes, and whether five masks keep their lead over one.
The systems were not trained alike: steps, heads and noise differ, see docs/trained_systems.md. Real depths are
stretched over the camera's range, and most of the sets are indoor. Not judged can be the paper's step from
FlyingThings3D to NYU Depth v2 where that set is not on the machine: its depth error there is nine (five masks) and ten
times (one mask) that on FlyingThings3D."""


def settings(scale: str) -> str:
    """Return what the results depend on."""
    size, count, most = SIZES[scale]
    return f"{count} painted and {most} real scenes of {size} px, {ELECTRONS:g} electrons of white at f/{F_NUMBER}."


EXPERIMENT = Experiment("transfer", "6. Transfer to real scenes", trials, measure, table, settings)

if __name__ == "__main__":
    sys.exit(not main(EXPERIMENT, __doc__ or ""))
