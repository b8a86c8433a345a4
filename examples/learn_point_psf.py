"""Learn masks with an average PSF close to a point at every depth: the paper's experiment without a network.

    python examples/learn_point_psf.py --masks 1 2 3 4 5 --trials 3

A sequence of K masks starts as noise and follows the gradient of the squared distance between its PSFs and the unit
impulse. The distance is 1 where the light is spread thin and 0 for a perfect point at all depths.

As in the paper, a longer sequence gains little in its best result and much in reliability: all starts end alike.

Source: Shah et al., TiDy-PSFs (ICCV 2023), the experiment on extended depth of field without a network.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from kornia_tidy import Fidelity, PixelwiseMask, TiDyOptics
from kornia_tidy.design import objectives

# Light that leaves the window is lost, not given back: a PSF is not rewarded for throwing light far away.
FIDELITY = Fidelity("point", pixel_tolerance=0.1, layer_spacing=5.0, window=23, stray_light="discard")


def main(arguments: Sequence[str] | None = None) -> dict[int, list[float]]:
    """Learn all sequences and return the final errors of the trials for each K."""
    options = parse(arguments)
    start = time.perf_counter()
    flat = TiDyOptics(PixelwiseMask(1, initial="flat"), fidelity=FIDELITY)
    print(f"no mask (a plain lens): error {float(point_error(flat).detach()):.4f}")
    histories: dict[int, list[list[float]]] = {}
    best: dict[int, TiDyOptics] = {}
    for count in options.masks:
        runs = [learn(count, seed, options.iterations, options.lr) for seed in range(options.trials)]
        histories[count] = [history for _, history in runs]
        best[count] = min(runs, key=lambda run: run[1][-1])[0]
        finals = [history[-1] for history in histories[count]]
        starts = [history[0] for history in histories[count]]
        print(
            f"K = {count}: error {mean(starts):.4f} -> {mean(finals):.4f} on average, {min(finals):.4f} to "
            f"{max(finals):.4f} over {options.trials} starts"
        )
    options.output.mkdir(parents=True, exist_ok=True)
    picture = options.output / "learn_point_psf.png"
    draw(picture, histories, flat, best)
    print(f"wrote {picture} after {time.perf_counter() - start:.0f} s")
    return {count: [history[-1] for history in runs] for count, runs in histories.items()}


def point_error(optics: TiDyOptics) -> Tensor:
    """Return the squared distance between PSF and unit impulse, averaged over depth, at 530 nm."""
    return objectives.point_error(optics.psf_bank(channels=1))


def learn(count: int, seed: int, iterations: int, lr_metres: float) -> tuple[TiDyOptics, list[float]]:
    """Learn one sequence of masks; return the camera and the error before every step."""
    noise = torch.Generator().manual_seed(seed)
    optics = TiDyOptics(PixelwiseMask(count, generator=noise), fidelity=FIDELITY)
    history = objectives.design(optics.masks, lambda: point_error(optics), iterations, lr_metres)
    return optics, history


def draw(path: Path, histories: dict[int, list[list[float]]], plain: TiDyOptics, best: dict[int, TiDyOptics]) -> None:
    """Draw how the error falls, where it ends, and the PSFs over depth before and after."""
    figure = Figure(figsize=(11, 9), layout="constrained")
    charts, montage = figure.subfigures(2, 1, height_ratios=(1, 1.25))
    falling, final = charts.subplots(1, 2, width_ratios=(1.5, 1))
    limit = float(point_error(plain).detach())
    colours = {count: f"C{index}" for index, count in enumerate(histories)}
    for count, runs in histories.items():
        steps, errors = range(len(runs[0])), np.array(runs)
        falling.fill_between(steps, errors.min(0), errors.max(0), color=colours[count], alpha=0.15, linewidth=0)
        falling.plot(steps, errors.mean(0), color=colours[count], label=f"K = {count}")
        final.plot([count] * len(runs), errors[:, -1], "o", color=colours[count], alpha=0.5)
    final.plot(list(histories), [mean([run[-1] for run in runs]) for runs in histories.values()], "k_-", markersize=16)
    for axes in (falling, final):
        axes.axhline(limit, color="grey", linestyle=":", label="plain lens")
        axes.grid(alpha=0.2)
        axes.spines[["top", "right"]].set_visible(False)
    lowest = min(run[-1] for runs in histories.values() for run in runs)
    falling.set(
        ylim=(2 * lowest - limit, 3 * limit - 2 * lowest), xlabel="gradient step", ylabel="squared distance to a point"
    )
    falling.set_title("learning: mean and range over the random starts")
    falling.legend(frameon=False)
    final.set(xlabel="masks K in the sequence", xticks=list(histories), title="at the end: each start, and their mean")

    shown = {"plain lens": plain, **{f"K = {count}": best[count] for count in sorted({*list(best)[::2], max(best)})}}
    banks = {name: optics.psf_bank(channels=1) for name, optics in shown.items()}
    depths = len(plain.defocus_nodes)
    for axes, name in zip(montage.subplots(len(banks), depths, squeeze=False), banks, strict=True):
        for index, (one, psf) in enumerate(zip(axes, banks[name].psfs[:, 0].detach().numpy(), strict=True)):
            one.imshow(np.sqrt(psf), cmap="magma", vmin=0, vmax=0.4)
            one.set(xticks=[], yticks=[], xlabel=f"{float(psf[psf.shape[0] // 2, psf.shape[0] // 2]):.1%}")
            if name == "plain lens":
                one.set_title(f"$\\psi$ = {plain.defocus_nodes[index]:.0f} rad", fontsize=10)
        axes[0].set_ylabel(name, fontsize=12)
    montage.suptitle("PSFs over defocus (square root of the light) and the share of the light in the centre pixel")
    figure.savefig(path, dpi=110)


def mean(values: Sequence[float]) -> float:
    """Return the arithmetic mean."""
    return sum(values) / len(values)


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--masks", type=int, nargs="+", default=[1, 2, 3, 4, 5], help="numbers K of masks to try")
    parser.add_argument("--trials", type=int, default=3, help="random starts for each K (default: 3)")
    parser.add_argument("--iterations", type=int, default=150, help="gradient steps (default: 150)")
    parser.add_argument("--lr", type=float, default=6e-8, help="learning rate to begin with, in metres (default: 6e-8)")
    parser.add_argument("--output", type=Path, default=Path("outputs/learn_point_psf"), help="folder to write to")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    torch.set_num_threads(1)  # the matrices are small: more threads would wait for each other
    main()
