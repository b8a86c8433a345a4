"""Kernels that a training step of the camera launches on an accelerator, and how often the host waits for it.

``python -m tests.benchmarks.launches [gather|scatter|occlusion ...]``. The step: 8 images of 3 x 278 x 278, five masks,
PSFs of 61 px, forward and backward to the masks, on the simulated device of the tests, after one step that fills the
memories. Counted are operators of torch, each for one launch, copies on the device included and views left out; waits
for a value, and copies from the host, which a CUDA graph cannot hold. The counts are those of any accelerator. They
depend on the number of layers in the scene for occlusion alone.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import NamedTuple

import torch
from tqdm import tqdm

from kornia_tidy import Fidelity, SensorNoise, TiDyOptics
from tests.simulated_device import SimulatedDevice

BATCH, SIDE, WINDOW = 8, 278, 61
COMPOSITINGS = ("gather", "scatter", "occlusion")


class Step(NamedTuple):
    """Counts of one training step."""

    launches: int
    waits: int
    uploads: int


def step_counts(
    compositing: str,
    *,
    fixed: bool,
    batch: int = BATCH,
    side: int = SIDE,
    window: int = WINDOW,
    steps: int = 2,
) -> list[Step]:
    """Return the counts of training steps that follow each other, each of another scene.

    Args:
        compositing: ``"gather"``, ``"scatter"`` or ``"occlusion"``.
        fixed: take the camera with fixed layers.
        batch: images.
        side: of the images in pixels.
        window: of the PSFs in pixels.
        steps: how many.
    """
    fidelity = replace(Fidelity.of("balanced"), window=window)
    optics = TiDyOptics(fidelity=fidelity, compositing=compositing, sensor=SensorNoise(0.01))
    counts = []
    with SimulatedDevice() as device:
        camera = device.put(optics.with_fixed_layers() if fixed else optics)
        for _ in range(steps):
            image = device.put(torch.rand(batch, 3, side, side))
            coarse = 0.3 + 5 * torch.rand(batch, 1, 4, 4)
            depth = device.put(torch.nn.functional.interpolate(coarse, (side, side), mode="bilinear"))
            camera.masks.phase.grad = None
            device.reset()
            camera(image, depth).square().mean().backward()
            counts.append(Step(device.launches, device.waits, device.uploads))
    return counts


def main(compositings: list[str]) -> None:
    """Print a row for each compositing: layers of the scene, and fixed layers."""
    torch.manual_seed(0)
    print(f"{BATCH} x 3 x {SIDE} x {SIDE}, five masks, PSFs of {WINDOW} px, forward and backward, second step")
    print(f"{'compositing':12} {'layers':8} {'launches':>8} {'waits':>6} {'uploads':>8}")
    for compositing in tqdm(compositings or COMPOSITINGS, leave=False):
        for layers, fixed in (("of scene", False), ("fixed", True)):
            last = step_counts(compositing, fixed=fixed)[-1]
            tqdm.write(f"{compositing:12} {layers:8} {last.launches:8d} {last.waits:6d} {last.uploads:8d}")


if __name__ == "__main__":
    main(sys.argv[1:])
