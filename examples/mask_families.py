"""Which family of masks learns how fast: gradient steps and time from noise to a stated error, for each family.

    python examples/mask_families.py --trials 5

Two tasks, each for one mask over nine depths from psi = -20 to 20 rad, at 530 nm:

- point: a PSF that is a point at every depth. The error is the squared distance to the unit impulse; 1 is light spread
  thin, and no mask comes near 0. One target for all families, so their errors can be compared.
- target: the PSFs of another mask of the same family, drawn at random. The error is the squared distance to them over
  their own square; 0 can be reached, but a descent may also end in another valley.

Source: Shah et al., TiDy-PSFs (ICCV 2023), the experiment on extended depth of field without a network.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from kornia_tidy import Fidelity, TiDyOptics
from kornia_tidy.masks import CubicMask, FourierMask, PhaseMasks, PixelwiseMask, RadialMask, SpiralMask, ZernikeMask

# Light that leaves the window is lost, not given back: a PSF is not rewarded for throwing light far away.
FIDELITY = Fidelity("families", pixel_tolerance=0.1, layer_spacing=5.0, window=23, stray_light="discard")

# Each family with its learning rate in metres of height: the less, the more shapes add up in a pixel.
FAMILIES: dict[str, tuple[Callable[[torch.Generator], PhaseMasks], float]] = {
    "pixelwise": (lambda noise: PixelwiseMask(1, generator=noise), 5e-8),
    "Zernike": (lambda noise: ZernikeMask(1, generator=noise), 1e-8),
    "radial": (lambda noise: RadialMask(1, generator=noise), 5e-8),
    "spiral": (lambda noise: SpiralMask(1, size=46, num_zones=3, generator=noise), 1e-7),
    "Fourier": (lambda noise: FourierMask(1, generator=noise), 1e-8),
    "cubic": (lambda noise: CubicMask(10 * torch.randn(1, generator=noise)), 2e-7),
}


def main(arguments: Sequence[str] | None = None) -> dict[tuple[str, str], list[list[float]]]:
    """Learn every family on both tasks, print the table and return the errors of each trial after every step."""
    options = parse(arguments)
    goals = {"point": options.point_error, "target": options.target_error}
    print(f"{options.trials} starts each, at most {options.iterations} steps; medians over the starts that get there")
    print("family     task     first   last   goal reached  steps  ms/step      s")
    histories: dict[tuple[str, str], list[list[float]]] = {}
    for family in FAMILIES:
        for task, goal in goals.items():
            runs = [learn(family, task, seed, options.iterations) for seed in range(options.trials)]
            histories[family, task] = [errors for errors, _ in runs]
            print(row(family, task, goal, runs))
    return histories


def learn(family: str, task: str, seed: int, iterations: int) -> tuple[list[float], float]:
    """Learn one mask from noise; return the error before every step and the seconds that a step takes."""
    make, lr_metres = FAMILIES[family]
    optics = TiDyOptics(make(torch.Generator().manual_seed(seed)), fidelity=FIDELITY)
    other = TiDyOptics(make(torch.Generator().manual_seed(1000 + seed)), fidelity=FIDELITY)
    target = impulse() if task == "point" else other.psf_bank(channels=1).psfs.detach()
    scale = target.square().sum()
    optimizer = torch.optim.Adam(optics.parameter_groups(lr_metres))
    errors = []
    start = time.perf_counter()
    for _ in range(iterations):
        optimizer.zero_grad()
        error = (optics.psf_bank(channels=1).psfs - target).square().sum() / scale
        error.backward()
        optimizer.step()
        errors.append(error.item())
    return errors, (time.perf_counter() - start) / iterations


def impulse() -> Tensor:
    """Return PSFs that are points, in the shape of a bank of one channel."""
    depths = len(TiDyOptics(PixelwiseMask(1), fidelity=FIDELITY).defocus_nodes)
    psfs = torch.zeros(depths, 1, 23, 23)
    psfs[..., 11, 11] = 1
    return psfs


def row(family: str, task: str, goal: float, runs: list[tuple[list[float], float]]) -> str:
    """Return the line of the table for the trials of one family."""
    first, last = (statistics.median(errors[end] for errors, _ in runs) for end in (0, -1))
    step = statistics.median(seconds for _, seconds in runs)
    reached = [steps for errors, _ in runs if (steps := steps_to(goal, errors)) is not None]
    start = f"{family:10} {task:7} {first:6.3f} {last:6.3f}  {goal:5.2f} {len(reached):>3}/{len(runs):<3}"
    if not reached:
        return f"{start} {'-':>6} {1e3 * step:8.1f} {'-':>6}"
    steps = statistics.median(reached)
    return f"{start} {steps:6.0f} {1e3 * step:8.1f} {steps * step:6.2f}"


def steps_to(goal: float, errors: Sequence[float]) -> int | None:
    """Return after how many steps the error is first at or below the goal, or None."""
    return next((steps for steps, error in enumerate(errors) if error <= goal), None)


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--trials", type=int, default=5, help="random starts for each family and task (default: 5)")
    parser.add_argument("--iterations", type=int, default=200, help="gradient steps (default: 200)")
    parser.add_argument("--point-error", type=float, default=0.94, help="goal of the point task (default: 0.94)")
    parser.add_argument("--target-error", type=float, default=0.4, help="goal of the target task (default: 0.4)")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    torch.set_num_threads(1)  # the matrices are small: more threads would wait for each other
    main()
