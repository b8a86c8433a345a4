"""Is a network right about how sure it is of depth? ``python -m tests.benchmarks.depth_uncertainty [SYSTEM ...]``.

A SYSTEM is a shipped one or a checkpoint. On half B of the real scenes, with PSFs of 129 pixels and all stray light, it
prints the RMSE of the depth over textured pixels, over all known pixels and over the surest 70 % of each scene, means
over the scenes with their standard errors; and over all scenes together the RMSE of the surest 70 % of all pixels, and
how far predicted errors are from found ones.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import torch
from torch import Tensor
from tqdm import tqdm

from kornia_tidy.reconstruction.depth_distribution import depth_moments
from kornia_tidy.reconstruction.reliability import reliability_curve, sparsification_curve
from kornia_tidy.reconstruction.tasks import depth_logits
from tests.benchmarks.results.captures import FIXED, capture, irradiance
from tests.benchmarks.results.restorations import takes_noise
from tests.benchmarks.results.scenes import BenchScene, real_scenes
from tests.benchmarks.results.scores import SURE, depth_scores, surest_error
from tests.benchmarks.results.systems import System, available, from_checkpoint
from tests.benchmarks.standard_error import mean_and_error

SHIPPED = "joint-uncertain"


@torch.no_grad()
def estimate(system: System, scene: BenchScene, noise: str) -> tuple[Tensor, Tensor]:
    """Return a network's depth of a scene and its standard deviation.

    Raises:
        ValueError: if the network does not tell how sure it is.
    """
    assert system.head is not None
    taken = capture(system, scene, irradiance(system, scene), noise)
    told = {"noise": taken.noise} if takes_noise(system) else {}
    logits = depth_logits("joint", system.head(taken.image, **told))
    if logits is None:
        raise ValueError(f"the network of {system.name} does not tell how sure it is of depth")
    return depth_moments(logits.float())


def row(system: System, noise: str) -> str:
    """Return a system's line of the table."""
    scenes = real_scenes()
    errors: dict[str, list[float]] = {"textured": [], "all": [], "surest": []}
    parts: list[list[Tensor]] = [[], [], []]
    for name in tqdm(scenes.half_b, desc=f"{system.name}, noise {noise}", leave=False):
        scene = scenes.load(name)
        depth, deviation = estimate(system, scene, noise)
        scores = depth_scores(scene, depth)
        surest = surest_error(scene, depth, deviation)
        for key, value in zip(errors, (scores["depth_textured"], scores["depth"], surest), strict=True):
            errors[key].append(value)
        for part, maps in zip(parts, (depth, deviation, scene.inverse_depth), strict=True):
            part.append(maps[scene.known].view(1, 1, 1, -1))
    together = [torch.cat(part, -1) for part in parts]
    curve, surest = reliability_curve(*together), sparsification_curve(*together, shares=(SURE,))
    words = [mean_and_error([value for value in values if math.isfinite(value)]) for values in errors.values()]
    words += [f"{float(surest):.3f}", f"{100 * curve.calibration_error():.0f} %"]
    return f"| {system.name} | {noise} | {' | '.join(words)} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.depth_uncertainty", description=__doc__)
    parser.add_argument("systems", nargs="*", default=[SHIPPED], metavar="SYSTEM", help=f"default: {SHIPPED}")
    parser.add_argument("--noises", nargs="+", choices=FIXED, default=FIXED[:1], metavar="NOISE")
    options = parser.parse_args()
    if not real_scenes().names:
        raise SystemExit("../shared/data is not on this machine: there are no scenes to measure")
    known = available()
    makers = [
        known[name] if name in known else (lambda path=Path(name): from_checkpoint(path)) for name in options.systems
    ]
    columns = (
        "RMSE, textured",
        "RMSE",
        "surest 70 % of each scene",
        "surest 70 % of all",
        "predicted from found errors",
    )
    print(f"| system | noise | {' | '.join(columns)} |")
    print("|---" * (2 + len(columns)) + "|")
    for make in makers:
        system = make()
        for noise in options.noises:
            print(row(system, noise), flush=True)


if __name__ == "__main__":
    main()
