"""Figure of the photon-transfer curve: variance over level with the fitted line and its noise components."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from kornia_tidy.figures.style import BLUE, FAINT, GREEN, INK, RED, new_figure, open_chart
from kornia_tidy.lab.calibration.noise.photon_transfer import ROUNDING, PhotonTransfer

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLORS = {"R": RED, "G": GREEN, "B": BLUE, "C": "#0e9aa7", "M": "#b0338f", "Y": "#c79a00"}
TITLE, LABEL, SMALL = 12, 9, 7.5  # pt
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
    line, gain = result.line, result.line.gain
    figure = new_figure(8.5, 5.0)
    axes = figure.subplots()
    for name in dict.fromkeys(point.channel for point in result.points):
        own = [point for point in result.points if point.channel == name and point.level > 0]
        signal, noise = [gain * point.level for point in own], [gain * math.sqrt(point.variance) for point in own]
        axes.plot(signal, noise, "o", label=name, markersize=4, color=COLORS.get(name, INK), zorder=3)
    top = max(point.level for point in result.points)
    levels = np.geomspace(min([point.level for point in result.points if point.level > 0] or [top]) / 2, top, STEPS)
    variances = {
        "read noise, rounding": np.full_like(levels, (line.read_noise / gain) ** 2 + ROUNDING),
        "shot noise": levels / gain,
        "fixed pattern": (line.fixed_pattern * levels) ** 2,
    }
    axes.plot(gain * levels, gain * np.sqrt(sum(variances.values())), color=INK, linewidth=1.2, label="together")
    for (label, variance), dashes in zip(variances.items(), (":", "--", "-."), strict=True):
        if variance.any():
            axes.plot(gain * levels, gain * np.sqrt(variance), dashes, color=FAINT, linewidth=1, label=label, zorder=1)
    open_chart(axes, LABEL, xscale="log", yscale="log", xlabel="signal, electrons", ylabel="noise, electrons")
    told = [f"{topic} {text}" for topic, text in result.in_words() if topic in {"levels", "gain", "read", "R²"}]
    figure.suptitle(f"Photon transfer: {result.in_words()[0][1]}", fontsize=TITLE, color=INK, weight="bold")
    axes.set_title("; ".join(told[:2]) + "\n" + "; ".join(told[2:]), fontsize=SMALL, color=FAINT)
    return figure
