"""Fits how sure a network is of depth to half A of the real scenes.

``python -m tests.benchmarks.fit_temperature FOLDER``
A network learns on scenes with painted depth, of which it is surer than it may be of real ones. The temperature of its
distribution is one number, and settings may be taken from half A. There predicted variances are to be as large as
squared errors on the average: the likelihood, by which training fits the temperature, heeds a few large errors so much
that the standard deviations of all other pixels become too large. The number is written into FOLDER/best.safetensors,
and how it was found into FOLDER/commands.txt.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import torch
from torch import Tensor
from tqdm import tqdm

from kornia_tidy.reconstruction.depth_distribution import depth_moments
from kornia_tidy.reconstruction.state_file import read_state, write_state
from kornia_tidy.reconstruction.tasks import depth_logits
from kornia_tidy.training.callbacks import BEST
from tests.benchmarks.results.captures import FIXED, capture, irradiance
from tests.benchmarks.results.scenes import real_scenes
from tests.benchmarks.results.systems import System, from_checkpoint
from tests.benchmarks.ship_networks import COMMANDS

EVERY = 7  # pixel in each direction: neighbours tell the same
COLDEST, HOTTEST, HALVINGS = 1 / 32, 32.0, 40


@torch.no_grad()
def samples(system: System) -> tuple[Tensor, Tensor, Tensor]:
    """Return logits (1, D, 1, N), depth and mask of half A at the least noise, without the network's temperature."""
    scenes = real_scenes()
    parts: list[list[Tensor]] = [[], [], []]
    for name in tqdm(scenes.half_a, desc="half A", leave=False):
        scene = scenes.load(name)
        taken = capture(system, scene, irradiance(system, scene), FIXED[0])
        logits = depth_logits("joint", system.head(taken.image, noise=taken.noise))
        assert logits is not None
        for part, maps in zip(parts, (logits, scene.inverse_depth, scene.known), strict=True):
            part.append(maps[..., ::EVERY, ::EVERY].flatten(2).unsqueeze(2))
    logits, depth, mask = (torch.cat(part, -1) for part in parts)
    return logits * float(system.head.temperature), depth, mask


def temperature_by_moments(logits: Tensor, depth: Tensor, mask: Tensor) -> float:
    """Return the temperature at which predicted variances are as large as squared errors, both averaged over pixels.

    Args:
        logits: (B, D, H, W), without any temperature.
        depth: (B, 1, H, W), normalised inverse depth.
        mask: bool (B, 1, H, W), True where the depth is known.

    Example:
        >>> logits = torch.tensor([3.0, 0.0]).view(1, 2, 1, 1).expand(1, 2, 1, 4)  # sure of 0
        >>> depth = torch.tensor([0.0, 0.0, 0.0, 1.0]).view(1, 1, 1, 4)  # one in four is 1: log 3 would be right
        >>> round(temperature_by_moments(logits, depth, torch.ones(1, 1, 1, 4, dtype=torch.bool)), 4)
        2.7307
    """
    low, high = math.log(COLDEST), math.log(HOTTEST)
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        mean, deviation = depth_moments(logits.double() / math.exp(middle))
        excess = (deviation.square() - (mean - depth).square())[mask].mean()
        low, high = (middle, high) if excess < 0 else (low, middle)
    return math.exp((low + high) / 2)


def main() -> None:
    """Fit and write the temperature."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.fit_temperature", description=__doc__)
    parser.add_argument("folder", type=Path, help=f"of a run of the task joint, with {BEST} and {COMMANDS}")
    folder = parser.parse_args().folder
    system = from_checkpoint(folder / BEST)
    before, found = float(system.head.temperature), temperature_by_moments(*samples(system))
    state = read_state(folder / BEST)
    for name, value in state["state_dict"].items():
        if name.endswith("temperature"):
            value.fill_(found)
    write_state(folder / BEST, state)
    told = f"; temperature of its depth {found:.3g} by half A of the real scenes, {before:.3g} by validation"
    (folder / COMMANDS).write_text((folder / COMMANDS).read_text().strip() + told + "\n")
    print(f"temperature {before:.3g} before, {found:.3g} now")


if __name__ == "__main__":
    main()
