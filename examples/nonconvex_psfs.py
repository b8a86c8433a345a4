"""Theorem 1 in numbers: an average of PSFs that no single mask can make.

    python examples/nonconvex_psfs.py

Only two points u and v of the aperture are as far apart as they are, so in the pupil's autocorrelation a single mask
has one unit phasor at v - u: modulus exactly 1. An average over K masks has the mean of K phasors there: below 1,
unless all agree. For K random masks it is 1 / sqrt(K) in the root mean square.

It shows the proof in seconds. How near the best single mask comes to such an average is experiment 1 of
`examples/paper/`.

Source: Shah et al., TiDy-PSFs (ICCV 2023), theorem 1.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure
from torch import Tensor

from kornia_tidy import PixelwiseMask
from kornia_tidy.design.non_convexity import autocorrelation_bound, extreme_points
from kornia_tidy.optics.aperture import circular_aperture


def main(arguments: Sequence[str] | None = None) -> dict[int, Tensor]:
    """Compute the autocorrelation bound of many random sets of masks and return it for each K."""
    options = parse(arguments)
    aperture = circular_aperture(23)
    noise = torch.Generator().manual_seed(options.seed)
    bounds = {
        count: torch.stack([bound_of(count, aperture, noise) for _ in range(options.sets)])
        for count in range(1, options.masks + 1)
    }
    for count, values in bounds.items():
        print(
            f"K = {count:2d}: autocorrelation {values.min():.9f} to {values.max():.9f}, "
            f"root mean square {values.square().mean().sqrt():.3f} (random phasors: {count**-0.5:.3f})"
        )
    print(f"single masks differ from 1 by at most {(bounds[1] - 1).abs().max():.1e}")
    options.output.mkdir(parents=True, exist_ok=True)
    picture = options.output / "nonconvex_psfs.png"
    draw(picture, aperture, bounds)
    print(f"wrote {picture}")
    return bounds


def bound_of(count: int, aperture: Tensor, noise: torch.Generator) -> Tensor:
    """Return the bound of one set of random masks."""
    return autocorrelation_bound(PixelwiseMask(count, generator=noise).phase.detach(), aperture)


def draw(path: Path, aperture: Tensor, bounds: dict[int, Tensor]) -> None:
    """Draw the aperture with its two extreme points, and the bound against the number of masks."""
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    pupil, chart = figure.subplots(1, 2, width_ratios=(1, 1.7))
    (y0, x0), (y1, x1) = extreme_points(aperture)
    pupil.imshow(aperture.numpy(), cmap="Greys", vmax=4)
    pupil.plot([x0, x1], [y0, y1], "o-", color="C3")
    for name, x, y, side in (("u", x0, y0, "right"), ("v", x1, y1, "left")):
        pupil.annotate(f" {name} ", (x, y), ha=side, va="center", color="C3", fontsize=14)
    pupil.set(xticks=[], yticks=[], title="one pair of points is this far apart")

    counts = list(bounds)
    values = torch.stack(list(bounds.values())).numpy()
    spread = 0.25 * (np.random.default_rng(0).random(values.shape) - 0.5)
    chart.plot(np.array(counts)[:, None] + spread, values, ".", color="C0", alpha=0.35, markersize=5)
    chart.plot(counts, np.sqrt((values**2).mean(1)), "_", color="k", markersize=16, label="root mean square")
    smooth = np.linspace(1, max(counts), 200)
    chart.plot(smooth, smooth**-0.5, "k:", label=r"$1/\sqrt{K}$: mean of random phasors")
    chart.axhline(1, color="C3", linewidth=1, label="every PSF of a single mask")
    chart.set(
        ylim=(0, 1.05), xticks=counts, xlabel="masks K in the average", ylabel=r"autocorrelation $|(X \star X)_{v-u}|$"
    )
    chart.set_title(f"below 1 no single mask makes the average ({values.shape[1]} random sets each)")
    chart.spines[["top", "right"]].set_visible(False)
    chart.legend(frameon=False, loc="upper right", bbox_to_anchor=(1, 0.96))
    figure.savefig(path, dpi=110)


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--masks", type=int, default=16, help="largest number K of masks (default: 16)")
    parser.add_argument("--sets", type=int, default=100, help="random sets for each K (default: 100)")
    parser.add_argument("--seed", type=int, default=0, help="of the masks (default: 0)")
    parser.add_argument("--output", type=Path, default=Path("outputs/nonconvex_psfs"), help="folder to write to")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    main()
