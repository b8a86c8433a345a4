"""Share of the camera in the time of a training step: PSFs, rendering and noise, forward and backward.

``python -m tests.benchmarks.training_step [head ...]``. Batch 8 of dead leaves, K = 5, the camera and the loss that
``kornia-tidy train`` has by default. One thread, and its own time on the processor, so that it matters little what else
runs there; medians of 5 steps.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from kornia_tidy import TiDyOptics
from kornia_tidy.data import DeadLeaves
from kornia_tidy.reconstruction import AttentionUNet, MiDaSSmall
from kornia_tidy.reconstruction.trained import build_optics
from kornia_tidy.training.settings import TrainingSettings

BATCH, STEPS, SIZES = 8, 5, (128, 278)
HEADS: dict[str, Callable[[], nn.Module]] = {
    "midas-small": MiDaSSmall,
    "attention-unet-8": lambda: AttentionUNet(width=8),
    "attention-unet-16": lambda: AttentionUNet(width=16),
    "attention-unet-64": AttentionUNet,
}


def scenes(size: int) -> dict[str, Tensor]:
    """Return a batch."""
    leaves = DeadLeaves(BATCH, size, size, depth_range=TrainingSettings().camera().depth_range)
    samples = [leaves[index] for index in range(BATCH)]
    return {name: torch.stack([sample[name] for sample in samples]) for name in ("image", "depth")}


def clocked_step(
    optics: TiDyOptics,
    head: nn.Module,
    adam: torch.optim.Optimizer,
    batch: dict[str, Tensor],
    now: Callable[[], float] = time.process_time,
) -> Any:
    """Take a step; return the seconds of the optics forward, the optics backward, and of all, by a clock."""
    clock = [now()]
    adam.zero_grad()
    sample = optics(batch)
    clock.append(now())
    coded = sample["image"].detach().requires_grad_()  # the step stops here on its way back, to look at the clock
    estimate = head(coded)
    truth = sample["all_in_focus"][:, : estimate.shape[1]]
    (estimate - truth).square().mean().backward()
    clock.append(now())
    sample["image"].backward(coded.grad)
    clock.append(now())
    adam.step()
    clock.append(now())
    return clock[1] - clock[0], clock[3] - clock[2], clock[4] - clock[0]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("heads", nargs="*", metavar="head", choices=[*HEADS, []], help="(default: all)")
    names = parser.parse_args().heads
    torch.set_num_threads(1)
    print("| head | size | optics forward, ms | backward, ms | step, ms | share |\n|---|---|---|---|---|---|")
    for size in SIZES:
        batch, settings = scenes(size), TrainingSettings(size=size)
        for name in names or list(HEADS):
            torch.manual_seed(0)
            optics, head = build_optics(settings).train(), HEADS[name]().train()
            learnt = [p for p in (*optics.parameters(), *head.parameters()) if p.requires_grad]
            adam = torch.optim.Adam(learnt, lr=1e-8)
            steps = [clocked_step(optics, head, adam, batch) for _ in range(STEPS + 1)][1:]
            forward, backward, whole = (1e3 * statistics.median(column) for column in zip(*steps, strict=True))
            share = 100 * (forward + backward) / whole
            print(f"| {name} | {size} | {forward:.0f} | {backward:.0f} | {whole:.0f} | {share:.1f} % |", flush=True)


if __name__ == "__main__":
    main()
