"""Experiment 9, boundaries: systems trained with one way of composing depth layers, scored with the other.

    python -m examples.paper.boundaries --scale smoke
    python -m examples.paper.boundaries --scale cpu

Gather, the paper's way, blurs each pixel by the PSF of its own depth. Occlusion composes layers from far to near:
near objects hide what is behind them, and their blur covers it, as in a camera. The systems that come with the package
were trained with gather. Scores are those of all pixels and of those near a step of depth.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence

import torch
from torch.nn import functional

from examples.paper.cameras import F_NUMBER
from examples.paper.closed_forms import ClosedForms
from examples.paper.report import WHERE, grid
from examples.paper.runner import Experiment, Row, Trial, main
from examples.paper.scenes import Budget, ForCamera, painted, real
from examples.paper.training import system_of
from kornia_tidy.inference.pretrained import load_pretrained
from kornia_tidy.inference.trained import TrainedSystem
from kornia_tidy.seeds import keyed_seed
from kornia_tidy.sensor.exposure import exposed_sensor

ELECTRONS = 57_000.0  # of white at f/17.6
SYSTEMS = {"smoke": ("edof-5",), "cpu": ("edof-5", "edof-1", "edof-flat")}
SIZES = {"smoke": (96, 1, 0), "cpu": (192, 6, 8), "gpu": (256, 64, 35), "paper": (256, 419, 35)}
"""Side of the scenes in pixels, and the numbers of painted and of real ones, by scale."""
EDGE, STEP = 9, 2.0  # pixels around, and radians of defocus, of a step of depth


def trials(scale: str) -> list[Trial]:
    """Return the trials: systems and ways of composing."""
    names = SYSTEMS.get(scale, SYSTEMS["cpu"])
    return [{"system": name, "scored_with": how} for name in names for how in ("gather", "occlusion")]


def measure(trial: Trial, scale: str) -> Mapping[str, float | str]:
    """Return the scores of a system in all pixels and near steps of depth."""
    shipped = load_pretrained(trial["system"])
    optics = shipped.optics
    optics.sensor = exposed_sensor(optics.camera.f_number, ELECTRONS, F_NUMBER)
    optics.compositing = trial["scored_with"]
    systems = {
        "network": system_of(optics, shipped.head, shipped.settings, shipped.step),
        "closed": system_of(optics, ClosedForms(optics, "edof"), shipped.settings, 0),
    }
    size, count, most = SIZES[scale]
    found: dict[str, float | str] = {}
    for where, scenes in (("painted", painted(Budget(size=size), "test", count)), ("real", real(most, size))):
        for what, system in systems.items():
            for name, value in edge_scores(system, ForCamera(scenes, optics.camera)).items():
                found[f"{what}_{where}_{name}"] = value
    return found


def edge_scores(system: TrainedSystem, scenes: ForCamera) -> dict[str, float]:
    """Return the mean PSNR over scenes, in all pixels and near steps of depth."""
    optics, scores = system.optics, {"all": [], "edges": []}
    for index in range(len(scenes)):
        sample = scenes[index]
        image, depth = sample["image"][None], sample["depth"][None]
        noise = torch.Generator().manual_seed(keyed_seed("boundaries", index))
        with torch.no_grad():
            error = (system.head(optics(image, depth, generator=noise)) - image).square().mean(1, keepdim=True)
        psi = optics.camera.defocus(depth).nan_to_num()
        half = EDGE // 2
        span = functional.max_pool2d(psi, EDGE, 1, half) + functional.max_pool2d(-psi, EDGE, 1, half)
        near = span > STEP
        scores["all"].append(float(-10 * error.mean().log10()))
        if near.any():
            scores["edges"].append(float(-10 * error[near].mean().log10()))
    return {name: sum(values) / len(values) for name, values in scores.items() if values}


def table(rows: Sequence[Row], scale: str) -> str:
    """Return PSNR of both ways of composing."""
    lines = []
    for row in rows:
        cells = [
            " / ".join(f"{float(row[name]):.2f}" for where in WHERE if (name := f"{what}_{where}_{part}") in row)
            for what in ("network", "closed")
            for part in ("all", "edges")
        ]
        lines.append([row["system"], row["scored_with"], *cells])
    heading = [
        "system, trained with gather",
        "scored with",
        "network",
        "network, edges",
        "closed form",
        "closed form, edges",
    ]
    return f"All in focus, PSNR in dB, painted / real scenes:\n\n{grid(heading, lines)}\n\n{JUDGED}"


JUDGED = """\
Judged can be what a system that was trained with gather loses, or gains, behind a camera that hides what is behind near
objects. Not judged can be the reverse, training with occlusion, which no shipped system has had. Edges are pixels
within 4 of a step of 2 rad of defocus."""


def settings(scale: str) -> str:
    """Return what the results depend on."""
    size, count, most = SIZES[scale]
    return f"{count} painted and {most} real scenes of {size} px, {ELECTRONS:g} electrons of white at f/{F_NUMBER}."


EXPERIMENT = Experiment("boundaries", "9. Boundaries of depth", trials, measure, table, settings)

if __name__ == "__main__":
    sys.exit(not main(EXPERIMENT, __doc__ or ""))
