"""Figure of measured PSFs over depth, with their uncertainty and the residuals of a fitted mask."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from kornia_tidy.figures.style import (
    ACCENT,
    BLUE,
    FAINT,
    GREEN,
    INK,
    LABEL,
    PHASE_COLORS,
    RED,
    TITLE,
    new_figure,
    open_chart,
)
from kornia_tidy.lab.calibration.psf.measured_psfs import MeasuredPSFs
from kornia_tidy.lab.calibration.psf.phase_retrieval import MaskFit
from kornia_tidy.psf.field_bank import FieldBank

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MOST_COLUMNS = 9  # distances drawn
CELL = 1.25  # inches
CHANNELS = {1: ("",), 3: (RED, GREEN, BLUE)}


def draw_measured(measured: MeasuredPSFs, fit: MaskFit | None = None) -> Figure:
    """Draw measured PSFs over distance, with their uncertainty, the fitted PSFs and the residuals of the fit.

    Args:
        measured: the PSFs.
        fit: the retrieved mask, or None.

    Returns:
        A figure; ``figure.savefig(path, dpi=150)``.

    Raises:
        ImportError: if matplotlib is missing.
        TypeError: if the PSFs are those of several places.

    Convention:
        - Far is left. PSFs are drawn with the square root of their light, each scaled to its brightest value; colour
          where there are three channels, else their mean.
        - Uncertainty and residual are means over the channels, in units of the PSF's brightest value. Each row has one
          scale, which is written beside it.
    """
    if isinstance(measured.bank, FieldBank):
        raise TypeError("PSFs of one place are drawn, got those of several: draw the measurement of each place")
    count = len(measured.distances)
    columns = torch.linspace(0, count - 1, min(count, MOST_COLUMNS)).round().long().tolist()
    psfs = measured.bank.psfs.cpu()
    peak = psfs.amax((1, 2, 3)).view(-1, 1, 1)
    relative = measured.uncertainty.cpu().mean(1) / peak
    rows: list[tuple[str, Tensor, float | None]] = [
        ("measured", psfs, None),
        ("uncertainty,\none standard deviation", relative, float(relative.max())),
    ]
    if fit is not None:
        left = (psfs - fit.psfs.cpu()).mean(1) / peak
        rows += [("the fitted mask's", fit.psfs.cpu(), None), ("measured less fitted", left, float(left.abs().max()))]
    width, height = max(7.5, CELL * (len(columns) + 1.6)), CELL * (len(rows) + 0.5) + 2.2
    figure = new_figure(width, height)
    parts: Any = figure.subfigures(2, 1, height_ratios=(CELL * (len(rows) + 0.5), 2.2))
    above, below = parts[0], parts[1]
    table = above.subplots(len(rows), len(columns), squeeze=False)
    for number, (line, (name, values, scale)) in enumerate(zip(table, rows, strict=True)):
        for axes, d in zip(line, columns, strict=True):
            _cell(axes, values[d], scale)
            if number == 0:
                title = f"{float(measured.distances[d]):.3g} m\nψ = {float(measured.bank.defocus[d]):+.1f}"
                axes.set_title(title, fontsize=LABEL, color=INK)
        words = name if scale is None else f"{name}\n(scale {'±' if float(values.min()) < 0 else ''}{scale:.1%})"
        line[0].set_ylabel(words, fontsize=LABEL, color=FAINT, rotation=0, ha="right", va="center")
    charts = below.subplots(1, 2 if fit is None else 3, width_ratios=(2, 2) if fit is None else (2, 2, 1))
    _noise_chart(charts[0], measured, fit)
    _misfit_chart(charts[1], measured)
    if fit is not None:
        _mask(charts[2], fit)
    return figure


def _cell(axes: Axes, values: Tensor, scale: float | None) -> None:
    if scale is not None:
        low = -scale if float(values.min()) < 0 else 0.0
        axes.imshow(values.numpy(), cmap="RdBu_r" if low else "magma", vmin=low, vmax=scale, interpolation="nearest")
    else:
        light = (values / values.max().clamp(min=1e-30)).clamp(min=0).sqrt()
        if len(light) == 3:
            axes.imshow(light.permute(1, 2, 0).numpy(), interpolation="nearest")
        else:
            axes.imshow(light.mean(0).numpy(), cmap="gray", vmin=0, vmax=1, interpolation="nearest")
    axes.set(xticks=[], yticks=[])


def _noise_chart(axes: Axes, measured: MeasuredPSFs, fit: MaskFit | None) -> None:
    """Chart the relative L1 difference over distance: expected from the noise, and left by the fit."""
    expected = math.sqrt(2 / math.pi) * measured.uncertainty.cpu().sum((2, 3))
    colors = CHANNELS.get(expected.shape[1], tuple(f"C{c}" for c in range(expected.shape[1])))
    for c, color in enumerate(colors):
        ink = color or INK
        axes.plot(measured.bank.defocus.cpu(), 100 * expected[:, c], "o-", color=ink, markersize=3, linewidth=1)
        if fit is not None:
            left = 100 * fit.residual[:, c].cpu()
            axes.plot(measured.bank.defocus.cpu(), left, "s:", color=ink, markersize=3, linewidth=1)
    words = "relative L1, %: noise (solid)" + ("" if fit is None else ",\nleft by the fit (dotted)")
    axes.set_ylim(bottom=0)
    open_chart(axes, LABEL, title=words, xlabel="defocus ψ, rad")


def _misfit_chart(axes: Axes, measured: MeasuredPSFs) -> None:
    """Chart the misfit of every point image, with rejected ones marked."""
    known = [(n, report) for n, report in enumerate(measured.reports) if report.misfit is not None]
    for color, rejected in ((INK, False), (ACCENT, True)):
        shown = [(n, report.misfit) for n, report in known if (report.rejected is not None) == rejected]
        axes.plot([n for n, _ in shown], [misfit for _, misfit in shown], ".", color=color, markersize=4)
    used = sum(report.rejected is None for report in measured.reports)
    axes.set_ylim(bottom=0)
    title = f"misfit of point images, 1 is noise;\n{used} of {len(measured.reports)} used"
    open_chart(axes, LABEL, title=title, xlabel="point image, far to near")


def _mask(axes: Axes, fit: MaskFit) -> None:
    phase = fit.lens.masks.phase.detach().cpu()[0].remainder(2 * math.pi)
    axes.imshow(phase.numpy(), cmap=PHASE_COLORS, vmin=0, vmax=2 * math.pi, interpolation="nearest")
    axes.set(xticks=[], yticks=[])
    axes.set_title("mask\nfound", fontsize=TITLE)
