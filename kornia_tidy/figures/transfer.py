"""Figure of the photon-transfer curve: variance over level with the fitted line and its noise components."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from kornia_tidy.figures.style import BLUE, FAINT, GREEN, INK, RED, open_chart, require_matplotlib
from kornia_tidy.lab.calibration.noise.photon_transfer import ROUNDING, PhotonTransfer

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLORS = {
    "R": RED,
    "G": GREEN,
    "B": BLUE,
    "C": "#0e9aa7",
    "M": "#b0338f",
    "Y": "#c79a00",
    "L": INK,
}
TITLE, LABEL, SMALL = 12, 9, 7.5  # pt
WIDTH, HEIGHT = 8.5, 5.0  # inches
STEPS = 400  # of a curve


def draw_transfer(result: PhotonTransfer) -> Figure:
    """Draw a photon-transfer calibration: noise over signal in electrons, its points and the fitted parts.

    Args:
        result: from :func:`~kornia_tidy.lab.calibration.noise.photon_transfer.photon_transfer` or a file.

    Returns:
        A figure; ``figure.savefig(path, dpi=150)`` makes it 1275 pixels wide.

    Raises:
        ImportError: if matplotlib is missing.
        ValueError: if there are no points.
    """
    if not result.points:
        raise ValueError("there is nothing to draw: the calibration has no points")
    require_matplotlib()
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure(figsize=(WIDTH, HEIGHT), facecolor="white")
    axes = figure.add_axes((0.1, 0.125, 0.87, 0.665))
    top = max(point.level for point in result.points)
    levels = np.geomspace(top / 1e4, top, STEPS)
    _noise(axes, result, levels)
    open_chart(axes, LABEL)
    axes.legend(fontsize=SMALL, frameon=False, loc="upper left")
    _titles(figure, result)
    return figure


def _parts(result: PhotonTransfer, levels: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the variance of read noise, shot noise and fixed pattern over the level."""
    line = result.line
    dark = np.full_like(levels, (line.read_noise / line.gain) ** 2 + ROUNDING)
    return dark, levels / line.gain, (line.fixed_pattern * levels) ** 2


def _noise(axes: Axes, result: PhotonTransfer, levels: np.ndarray) -> None:
    gain = result.line.gain
    dark, shot, pattern = (gain * np.sqrt(part) for part in _parts(result, levels))
    for name in dict.fromkeys(point.channel for point in result.points):
        own = [point for point in result.points if point.channel == name and point.level > 0]
        axes.plot(
            [gain * point.level for point in own],
            [gain * math.sqrt(point.variance) for point in own],
            "o",
            label=name,
            markersize=4,
            markeredgecolor="white",
            markeredgewidth=0.5,
            color=COLORS.get(name, INK),
            zorder=3,
        )
    electrons = gain * levels
    axes.plot(electrons, np.sqrt(dark**2 + shot**2 + pattern**2), color=INK, linewidth=1.2, label="together", zorder=2)
    axes.plot(electrons, shot, color=FAINT, linewidth=1, linestyle=(0, (4, 3)), label="shot noise", zorder=1)
    axes.plot(electrons, dark, color=FAINT, linewidth=1, linestyle=(0, (1, 2)), label="read noise, rounding", zorder=1)
    if pattern.any():
        axes.plot(electrons, pattern, color=FAINT, linewidth=1, linestyle="-.", label="fixed pattern", zorder=1)
    seen = [gain * math.sqrt(point.variance) for point in result.points]
    lit = [gain * point.level for point in result.points if point.level > 0]
    axes.set_xscale("log")
    axes.set_yscale("log")
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(lambda value, _=None: f"{value:g}")
        axis.set_minor_formatter(lambda value, _=None: f"{value:g}" if f"{value:e}"[0] in "25" else "")
    axes.set_xlim(min(lit) / 2 if lit else None, 1.3 * electrons[-1])
    axes.set_ylim(min(*seen, float(dark[0])) / 1.6, 2.2 * max(seen))
    axes.set_xlabel("signal, electrons", fontsize=LABEL, color=INK)
    axes.set_ylabel("noise, electrons", fontsize=LABEL, color=INK)


def _titles(figure: Figure, result: PhotonTransfer) -> None:
    line = result.line
    camera = result.camera or "camera unknown"
    iso = "" if result.iso is None else f", ISO {result.iso:g}"
    how = "from a single picture" if result.method == "single" else "from flats"
    without = " without the fixed pattern" if line.fixed_pattern else ""
    figure.text(0.025, 0.93, f"Photon transfer: {camera}{iso}", fontsize=TITLE, color=INK, weight="bold")
    words = (
        f"gain {line.gain:.4g} ± {line.gain_error:.2g} electrons a count, read noise {line.read_noise:.3g} ± "
        f"{line.read_noise_error:.2g} electrons, R² {line.r_squared:.4f}{without}; {how}, {len(result.points)} points "
        f"of {line.samples:,} samples; black {result.black:g}, white {result.white:g}"
    )
    figure.text(0.025, 0.87, words, fontsize=SMALL, color=FAINT)
