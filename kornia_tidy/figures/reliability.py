"""Figure of the reliability of estimated depth: found error over predicted error, and error of the surest pixels."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, NamedTuple

from torch import Tensor

from kornia_tidy.figures.style import ACCENT, BLUE, FAINT, GREEN, INK, open_chart, require_matplotlib
from kornia_tidy.reconstruction.reliability import ReliabilityCurve

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLORS = (ACCENT, BLUE, GREEN, INK)
TITLE, LABEL, SMALL = 12, 9, 7.5  # pt
WIDTH, HEIGHT = 10.5, 4.8  # inches
WITHIN = 0.2  # relative difference of found and predicted error, drawn as a band


class Reliability(NamedTuple):
    """Curves of one estimate of depth."""

    curve: ReliabilityCurve
    """Found and predicted errors, from :func:`~kornia_tidy.reconstruction.reliability.reliability_curve`."""
    shares: tuple[float, ...]
    """Parts of the pixels, the surest ones."""
    errors: Tensor
    """(len(shares),), from :func:`~kornia_tidy.reconstruction.reliability.sparsification_curve`."""


def draw_reliability(estimates: Mapping[str, Reliability]) -> Figure:
    """Draw reliability and sparsification curves of several estimates of depth, for example before and after a fit.

    Args:
        estimates: curves by name, four at most, in parts of the depth range.

    Returns:
        A figure; ``figure.savefig(path, dpi=150)`` makes it 1575 pixels wide.

    Raises:
        ImportError: if matplotlib is missing.
        ValueError: if there are no estimates or more than four.
    """
    if not 0 < len(estimates) <= len(COLORS):
        raise ValueError(f"the picture shows 1 to {len(COLORS)} estimates, got {len(estimates)}")
    require_matplotlib()
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure(figsize=(WIDTH, HEIGHT), facecolor="white")
    reliable, surest = (figure.add_axes((left, 0.13, 0.40, 0.70)) for left in (0.075, 0.575))
    most = max(float(value) for each in estimates.values() for part in each.curve for value in part) * 1.08
    reliable.fill_between([0, most], [0, most * (1 - WITHIN)], [0, most * (1 + WITHIN)], color="#e8ecef", linewidth=0)
    reliable.plot([0, most], [0, most], color=FAINT, linewidth=1, linestyle=(0, (4, 3)))
    for (name, each), color in zip(estimates.items(), COLORS, strict=False):
        told = f"{name}: off by {each.curve.calibration_error():.0%}"
        reliable.plot(
            *(part.cpu().numpy() for part in each.curve), "o-", color=color, markersize=4, linewidth=1.2, label=told
        )
        errors = each.errors.cpu().numpy()
        surest.plot([100 * share for share in each.shares], errors, color=color, linewidth=1.4, label=name)
    reliable.set(xlim=(0, most), ylim=(0, most))
    surest.set(xlim=(0, 100), ylim=(0, None))
    for axes, across, up in (
        (reliable, "predicted standard deviation, parts of the range", "found RMS error"),
        (surest, "surest pixels, %", "their RMS error, parts of the range"),
    ):
        open_chart(axes, LABEL)
        axes.set_xlabel(across, fontsize=LABEL, color=INK)
        axes.set_ylabel(up, fontsize=LABEL, color=INK)
        axes.legend(fontsize=SMALL, frameon=False, loc="upper left")
    figure.text(0.025, 0.93, "Reliability of the estimated depth", fontsize=TITLE, color=INK, weight="bold")
    band = f"bins of equally many pixels; band: found within {WITHIN:.0%} of predicted"
    figure.text(0.975, 0.935, band, fontsize=SMALL, color=FAINT, ha="right")
    return figure
