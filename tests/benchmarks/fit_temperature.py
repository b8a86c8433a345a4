"""Fits how sure a network is of depth to half A of the real scenes.

``python -m tests.benchmarks.fit_temperature FOLDER``
A network learns on painted scenes, of which it is surer than it may be of photographs. The temperature of its
distribution is one number, and settings may be taken from half A. It is written into FOLDER/best.safetensors, and how
it was found into FOLDER/commands.txt.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch
from torch import Tensor
from tqdm import tqdm

from kornia_tidy.inference.state_file import read_state, write_state
from kornia_tidy.inference.tasks import depth_logits
from kornia_tidy.reconstruction.depth_distribution import fit_temperature
from kornia_tidy.training.callbacks import BEST
from tests.benchmarks.results.captures import FIXED, capture, irradiance
from tests.benchmarks.results.scenes import real_scenes
from tests.benchmarks.results.systems import System, from_checkpoint
from tests.benchmarks.ship_networks import COMMANDS

EVERY = 7  # pixel in each direction: neighbours tell the same


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


def main() -> None:
    """Fit and write the temperature."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.fit_temperature", description=__doc__)
    parser.add_argument("folder", type=Path, help=f"of a run of the task joint, with {BEST} and {COMMANDS}")
    folder = parser.parse_args().folder
    system = from_checkpoint(folder / BEST)
    before, found = float(system.head.temperature), fit_temperature(*samples(system))
    state = read_state(folder / BEST)
    for name, value in state["state_dict"].items():
        if name.endswith("temperature"):
            value.fill_(found)
    write_state(folder / BEST, state)
    told = f"; temperature of its depth {found:.3g} by half A of the real scenes, {before:.3g} by painted ones"
    (folder / COMMANDS).write_text((folder / COMMANDS).read_text().strip() + told + "\n")
    print(f"temperature {before:.3g} before, {found:.3g} now")


if __name__ == "__main__":
    main()
