"""Learn masks that know of switching: the task of learn_point_psf.py on a modulator that is slow between masks.

    python examples/learn_with_switching.py --between exponential --switching-time 0.016

A sequence of K masks is learnt once for an ideal modulator and once with the states in between, and both are shown by
the slow one. Light in between is not lost on masks that expect it: neighbours in the sequence come closer together, and
where dwell times may be learnt as well, the exposure goes to the masks that are worth it.

Measured with the defaults (K = 5, four swaps of 16 ms in 100 ms, means of three starts; a plain lens has 0.9249, masks
learnt without switching have 0.9118 where there is none):

| between     | learnt without | learnt with | and dwell times |
|-------------|----------------|-------------|-----------------|
| exponential | 0.9290         | 0.9260      | 0.9251          |
| linear      | 0.9430         | 0.9310      | 0.9299          |
| random      | 0.9653         | 0.9650      | 0.9651          |

So learning with switching takes back a sixth of what switching costs where the crystal relaxes, more than a third where
it moves evenly, and next to nothing where the states in between are random, as these do not depend on the masks. Where
the crystal relaxes it pays from swaps of 6 ms on. For a modulator as slow as 16 ms five masks are too many: none of
these is better than a plain lens.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import torch
from learn_point_psf import FIDELITY, mean, point_error
from matplotlib.figure import Figure
from torch import nn

from kornia_tidy import DwellTimes, LearnableDwellTimes, PixelwiseMask, Switching, TiDyOptics
from kornia_tidy.modulator.switching import BETWEEN

UNSEEN = range(10_000, 10_008)  # seeds of random states that no training has seen


def main(arguments: Sequence[str] | None = None) -> dict[str, list[list[float]]]:
    """Learn all sequences; return the error of each trial at each switching time, for each way of learning."""
    options = parse(arguments)
    start = time.perf_counter()
    times = [options.switching_time * share for share in (0, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 1)]
    equal, slow = [1.0] * options.masks, options.switching_time
    ways = {
        "learnt without switching": DwellTimes,
        "learnt with switching": lambda: Switching(slow, between=options.between),
        "and dwell times": lambda: Switching(slow, between=options.between, dwell=LearnableDwellTimes(equal)),
    }
    errors = {}
    for name, modulator in ways.items():
        trials = [learn(options, seed, modulator()) for seed in range(options.trials)]
        errors[name] = [[error_at(optics, options.between, t) for t in times] for optics in trials]
        rows = list(zip(*errors[name], strict=True))
        print(f"{name:>25}: {mean(rows[0]):.4f} at 0 ms, {mean(rows[-1]):.4f} at {slow * 1e3:g} ms")
    flat = TiDyOptics(PixelwiseMask(1, initial="flat"), fidelity=FIDELITY)
    options.output.mkdir(parents=True, exist_ok=True)
    picture = options.output / f"learn_with_switching_{options.between}.png"
    draw(picture, times, errors, float(point_error(flat).detach()))
    print(f"wrote {picture} after {time.perf_counter() - start:.0f} s")
    return errors


def learn(options: argparse.Namespace, seed: int, modulator: nn.Module) -> TiDyOptics:
    """Learn one sequence of masks, and dwell times where the modulator has them to learn."""
    noise = torch.Generator().manual_seed(seed)
    optics = TiDyOptics(PixelwiseMask(options.masks, generator=noise), modulator=modulator, fidelity=FIDELITY)
    optimizer = torch.optim.Adam(optics.parameter_groups(options.lr, lr=0.05))
    for step in range(options.iterations):
        if isinstance(modulator, Switching):
            modulator.seed = step  # other random states each time, so that none is learnt by heart
        optimizer.zero_grad()
        point_error(optics).backward()
        optimizer.step()
    return optics


@torch.no_grad()
def error_at(optics: TiDyOptics, between: str, switching_time: float) -> float:
    """Return the error of learnt masks and dwell times on a modulator that takes this long between masks."""
    dwell = optics.modulator.dwell if isinstance(optics.modulator, Switching) else optics.modulator
    slow = Switching(switching_time, between=between, dwell=dwell)
    shown = TiDyOptics(optics.masks, modulator=slow, fidelity=FIDELITY)
    found = []
    for slow.seed in UNSEEN if between == "random" else (0,):
        found.append(float(point_error(shown)))
    return mean(found)


def draw(path: Path, times: Sequence[float], errors: dict[str, list[list[float]]], plain: float) -> None:
    """Draw the error over switching time."""
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.subplots()
    milliseconds = [t * 1e3 for t in times]
    for name, trials in errors.items():
        rows = list(zip(*trials, strict=True))
        (line,) = axes.plot(milliseconds, [mean(row) for row in rows], "o-", label=name)
        axes.fill_between(
            milliseconds, [min(r) for r in rows], [max(r) for r in rows], color=line.get_color(), alpha=0.15
        )
    axes.axhline(plain, color="grey", linestyle=":", label="plain lens")
    axes.set(xlabel="switching time in ms, of an exposure of 100 ms", ylabel="squared distance to a point")
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(alpha=0.2)
    axes.legend(frameon=False)
    figure.savefig(path, dpi=110)


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--between", choices=BETWEEN, default="exponential", help="states between two masks")
    parser.add_argument("--switching-time", type=float, default=0.016, help="seconds a swap takes (default: 0.016)")
    parser.add_argument("--masks", type=int, default=5, help="number K of masks (default: 5)")
    parser.add_argument("--trials", type=int, default=3, help="random starts (default: 3)")
    parser.add_argument("--iterations", type=int, default=150, help="gradient steps (default: 150)")
    parser.add_argument("--lr", type=float, default=2e-8, help="learning rate in metres of height (default: 2e-8)")
    parser.add_argument("--output", type=Path, default=Path("outputs/learn_with_switching"), help="folder to write to")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    torch.set_num_threads(1)  # the matrices are small: more threads would wait for each other
    main()
