"""How the error of float32 grows with defocus, masks, window, layers and image."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from tqdm import tqdm

from kornia_tidy import DefocusRange, Fidelity
from tests.extremes.exposure import camera
from tests.extremes.row import rounding, scene

UNIT = 2.0**-24  # rounding of float32 below 1


class Curve(NamedTuple):
    """Errors along one quantity."""

    quantity: str
    values: Sequence[float]
    error: Callable[[float], float]
    """Largest difference of a capture in float32 from float64, full scale 1."""


def _capture(height: int = 64, **options: object) -> float:
    image, depth = scene(height, height)
    return rounding(camera(**options), image, depth)


def _at_defocus(psi: float) -> float:
    image, _ = scene(64, 64)
    disparity = torch.linspace(0, 1, 64, dtype=torch.float64).expand(1, 1, 64, 64).contiguous()
    return rounding(camera(camera=DefocusRange(-psi, psi)), image, disparity)


def _in_window(side: float) -> float:
    return _capture(160, fidelity=Fidelity.preset("draft").replace(window=int(side)))


CURVES = (
    Curve("largest defocus, rad", (2, 20, 60, 200), _at_defocus),
    Curve("masks K", (1, 4, 16, 64, 256), lambda count: _capture(masks=int(count))),
    Curve("window, px", (9, 33, 65, 129, 257), _in_window),
    Curve("layers", (5, 20, 80, 320), lambda count: _capture(
        fidelity=Fidelity.preset("balanced").replace(layer_spacing=40 / count, window=33))),
    Curve("side of the image, px", (32, 128, 512, 1024), lambda side: _capture(int(side))),
)  # fmt: skip


def measured(progress: tqdm | None = None) -> dict[str, list[tuple[float, float]]]:
    """Return pairs of value and error, in units of the rounding of float32, by quantity."""
    found = {}
    for curve in CURVES:
        pairs = []
        for value in curve.values:
            if progress is not None:
                progress.set_postfix_str(f"{curve.quantity} {value:g}")
            pairs.append((float(value), curve.error(value) / UNIT))
            if progress is not None:
                progress.update()
        found[curve.quantity] = pairs
    return found


def draw(curves: dict[str, list[tuple[float, float]]], path: Path) -> None:
    """Plot the errors over each quantity."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, len(curves), figsize=(13, 2.8), sharey=True, layout="constrained")
    highest = max(error for pairs in curves.values() for _, error in pairs)
    for plot, (quantity, pairs) in zip(axes, curves.items(), strict=True):
        plot.semilogx(*zip(*pairs, strict=True), "o-", color="#3465a4")
        plot.set_xlabel(quantity)
        plot.set_ylim(0, 1.1 * highest)
        plot.grid(visible=True, alpha=0.3)
    axes[0].set_ylabel("largest error, units of $2^{-24}$")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=80)
    plt.close(figure)
