"""Figure of PSFs: a montage over depth and colour, a slice through focus, and the modulation transfer function."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, cast

import numpy as np

from kornia_tidy.figures.psf_measures import PSFMeasures
from kornia_tidy.figures.style import DEPTH_COLORS, FAINT, INK, new_figure, open_chart, shown
from kornia_tidy.figures.system_statistics import ring_centres

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

HEADLINE, LABEL, SMALL = 13, 8.5, 7.5  # pt
CELL, PLOTS = 1.25, 3.0  # inches


def draw_psfs(measured: PSFMeasures, title: str) -> Figure:
    """Draw a montage of PSFs, and below it the slice through focus and the modulation transfer function.

    Args:
        measured: PSFs and transfer functions.
        title: heading of the figure.

    Returns:
        A figure; ``figure.savefig(path, dpi=150)`` makes it some 1600 pixels wide for seven depths.

    Raises:
        ImportError: if matplotlib is missing.

    Convention:
        - Each PSF of the montage is scaled to its own brightest pixel. Both colour scales are linear in the square root
          of the light, so that faint parts are visible.
    """
    columns, rows = measured.psfs.shape[:2]
    tall = CELL * rows + 0.6
    size = max(8.5, CELL * columns + 2), tall + PLOTS + 0.4
    figure = new_figure(*size)
    figure.suptitle(shown(title), fontsize=HEADLINE, color=INK, weight="bold")
    above, below = cast("Any", figure.subfigures(2, 1, height_ratios=(tall, PLOTS)))
    _montage(above, measured)
    left, right = below.subplots(1, 2)
    _slice(left, measured)
    _transfer(right, measured)
    return figure


def _montage(figure: SubFigure, measured: PSFMeasures) -> None:
    from matplotlib.cm import ScalarMappable  # noqa: PLC0415
    from matplotlib.colors import PowerNorm  # noqa: PLC0415

    (columns, rows), side = measured.psfs.shape[:2], measured.psfs.shape[-1]
    cells, scale = figure.subplots(rows, columns, squeeze=False), PowerNorm(0.5, 0, 1)
    for (row, column), axes in np.ndenumerate(cells):
        light = measured.psfs[column, row].clamp(min=0)
        axes.imshow((light / light.amax()).numpy(), cmap=DEPTH_COLORS, norm=scale)
        axes.set(xticks=[], yticks=[])
        if row == 0:
            axes.set_title(f"{measured.depths[column]}\n{_psi(measured.defocus[column])}", fontsize=LABEL, color=INK)
        if column == 0:
            axes.set_ylabel(measured.channels[row], fontsize=LABEL, color=INK)
    length = max(1, round(side / 5))
    cells[0, 0].plot([0.06 * side, 0.06 * side + length], [0.92 * side] * 2, color="white", linewidth=2)
    cells[0, 0].text(0.06 * side, 0.86 * side, f"{length} px", color="white", fontsize=SMALL)
    mapped = ScalarMappable(scale, DEPTH_COLORS)
    bar = figure.colorbar(mapped, ax=cells, fraction=0.025, ticks=[0, 0.1, 0.25, 0.5, 1])
    bar.set_label("light, brightest pixel = 1", fontsize=SMALL, color=INK)
    bar.ax.tick_params(labelsize=SMALL)


def _slice(axes: Axes, measured: PSFMeasures) -> None:
    from matplotlib.colors import PowerNorm  # noqa: PLC0415

    half, percent = measured.slices.shape[-1] / 2, 100 * measured.slices.clamp(min=0).numpy()
    extent = (-half, half, float(measured.focus[0]), float(measured.focus[-1]))
    scale = PowerNorm(0.5, 0)
    light = axes.imshow(percent, origin="lower", aspect="auto", extent=extent, cmap=DEPTH_COLORS, norm=scale)
    axes.set_title(f"Slice through focus, {_middle(measured)}", fontsize=LABEL + 1, color=INK)
    axes.set_xlabel("column from the chief ray, pixels", fontsize=LABEL, color=INK)
    axes.set_ylabel("defocus ψ, rad (near is up)", fontsize=LABEL, color=INK)
    axes.tick_params(labelsize=SMALL)
    bar = axes.figure.colorbar(light, ax=axes, fraction=0.05, pad=0.02)
    bar.set_label("light in the pixel, %", fontsize=SMALL, color=INK)
    bar.ax.tick_params(labelsize=SMALL)


def _transfer(axes: Axes, measured: PSFMeasures) -> None:
    from matplotlib import colormaps  # noqa: PLC0415

    frequency = [0, *ring_centres(measured.contrast.shape[-1])]
    middle = measured.contrast[:, len(measured.channels) // 2]
    for index, (depth, psi, curve) in enumerate(zip(measured.depths, measured.defocus, middle, strict=True)):
        color = colormaps["viridis"](0.9 * index / max(len(measured.depths) - 1, 1))
        axes.plot(frequency, [1, *curve.tolist()], color=color, linewidth=1.4, label=f"{depth}, {_psi(psi)}")
    axes.axhline(0.5, color=FAINT, linewidth=0.8, linestyle=(0, (4, 3)))
    title, scale = f"Contrast (MTF), mean of all directions, {_middle(measured)}", "spatial frequency, cycles a pixel"
    open_chart(axes, LABEL, xlim=(0, 0.5), ylim=(0, 1.02), title=title, xlabel=scale, ylabel="contrast")


def _psi(defocus: float) -> str:
    return f"ψ = {defocus:+.3g}" if defocus else "ψ = 0"


def _middle(measured: PSFMeasures) -> str:
    return measured.channels[len(measured.channels) // 2]
