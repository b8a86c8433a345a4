"""Figure of the speed-accuracy trade-off: error over time, a line for each swept setting, and the Pareto front."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from kornia_tidy.design.tradeoff.files import TradeRun, value_in_words
from kornia_tidy.design.tradeoff.measure import TradeRow, pareto
from kornia_tidy.design.tradeoff.sweep_settings import PLAN, PRESET, SWEEP_VALUES
from kornia_tidy.figures.style import FAINT, INK, new_figure, open_chart

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's colours for colour-blind readers, without the yellow, which is invisible on white.
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#7a5195")
MARKERS = ("o", "s", "^", "v", "D", "P", "X")
FRONT = "#c9d3dc"
TITLE, LABEL, SMALL = 12, 9, 7.5  # pt
WIDTH, HEIGHT = 10.0, 6.2  # inches
GAP = 3.0  # an error of zero is drawn at the smallest other error divided by this


def draw_trade(run: TradeRun) -> Figure:
    """Draw error over time for the rows of a sweep.

    Args:
        run: rows and conditions, from :func:`~kornia_tidy.design.tradeoff.files.read_json`.

    Returns:
        A figure; ``figure.savefig(path, dpi=150)`` makes it 1500 pixels wide.

    Raises:
        ImportError: if matplotlib is missing.
        ValueError: if there are no rows.

    Convention:
        Both axes are logarithmic. An error of zero, which the reference has by definition, lies on the lower edge.
    """
    if not run.rows:
        raise ValueError("there is nothing to draw: the sweep has no rows")
    figure = new_figure(WIDTH, HEIGHT, layout=None)
    axes = figure.add_axes((0.085, 0.125, 0.635, 0.735))
    floor = min((row.rmse for row in run.rows if row.rmse > 0), default=1.0) / GAP
    _frame(axes, run, floor)
    _front(axes, run.rows, floor)
    for number, knob in enumerate(name for name in SWEEP_VALUES if name != PRESET):
        steps = sorted((row for row in run.rows if row.knob == knob), key=_order)
        if len({(row.capture_seconds, row.rmse) for row in steps}) > 1:
            ends = " to ".join(value_in_words(row).removesuffix(", measured") for row in (steps[0], steps[-1]))
            line = axes.plot(*_places(steps, floor), f"{MARKERS[number]}-", color=COLORS[number], markersize=5)
            line[0].set(label=f"{knob}, {ends}", linewidth=1.3, zorder=3)
    if plans := sorted((row for row in run.rows if row.knob == PLAN), key=_order):
        axes.plot(*_places(plans, floor), "o-", color=INK, linewidth=2, label="plan, by tolerance", zorder=3.5)
        _label(axes, [f"{row.value:.0e}".replace("e-0", "e-") for row in plans], plans, floor, (-6, -11))
    if presets := [row for row in run.rows if row.knob == PRESET]:
        axes.scatter(*_places(presets, floor), 150, INK, marker="*", edgecolor="white", label="presets", zorder=4)
        _label(axes, [str(row.value) for row in presets], presets, floor, (6, 6))
    _titles(figure, run)
    figure.legend(loc="upper left", bbox_to_anchor=(0.73, 0.868), fontsize=LABEL, frameon=False, labelspacing=0.75)
    return figure


def _places(rows: Sequence[TradeRow], floor: float) -> tuple[list[float], list[float]]:
    """Return times in milliseconds and errors."""
    return [1e3 * row.capture_seconds for row in rows], [max(row.rmse, floor) for row in rows]


def _label(axes: Axes, words: Sequence[str], rows: Sequence[TradeRow], floor: float, offset: tuple[int, int]) -> None:
    for text, place in zip(words, zip(*_places(rows, floor), strict=True), strict=True):
        axes.annotate(text, place, offset, textcoords="offset points", fontsize=SMALL, color=INK, zorder=5)


def _frame(axes: Axes, run: TradeRun, floor: float) -> None:
    times = [1e3 * row.capture_seconds for row in run.rows]
    highest = 2 * max(2 * floor, *(row.rmse for row in run.rows))
    axes.set(xscale="log", yscale="log", xlim=(min(times) / 1.35, max(times) * 1.5), ylim=(floor / 1.6, highest))
    what = "error: RMSE of the noise-free linear capture, full scale 1"
    open_chart(axes, LABEL, xlabel="time of a capture, PSF bank and rendering, ms", ylabel=what)
    axes.xaxis.set_major_formatter("{x:g}")
    if any(row.rmse == 0 for row in run.rows):
        axes.axhline(floor, color=FAINT, linewidth=0.6, linestyle=(0, (2, 3)), zorder=1)
        axes.annotate(
            f"no error: this is {run.conditions.reference!r}, to which errors refer",
            (0.005, floor),
            xycoords=("axes fraction", "data"),
            xytext=(0, 3),
            textcoords="offset points",
            fontsize=SMALL,
            color=FAINT,
        )


def _front(axes: Axes, rows: Sequence[TradeRow], floor: float) -> None:
    x, y = _places(pareto(rows), floor)
    # The front is extended straight beyond its ends: no row is faster on the left or more accurate on the right.
    x, y = [x[0], *x, axes.get_xlim()[1]], [axes.get_ylim()[1], *y, y[-1]]
    axes.step(x, y, where="post", color=FRONT, linewidth=5, solid_joinstyle="round", zorder=1.5, label="Pareto front")


def _order(row: TradeRow) -> float:
    """Return the sort key of a row along its line: the numeric value, or the measured window; 0 for names."""
    value = row.window if row.value is None else row.value
    return 0.0 if isinstance(value, str) else float(value)


def _titles(figure: Figure, run: TradeRun) -> None:
    here = run.conditions
    figure.text(0.03, 0.945, "Speed-accuracy trade-off", fontsize=TITLE, color=INK, weight="bold")
    about = (
        f"{here.scene}, {here.width} × {here.height} px, K = {here.masks} masks, {here.compositing}; "
        f"along each thin line one setting changes"
    )
    figure.text(0.03, 0.9, about, fontsize=LABEL, color=FAINT)
    threads = f", {here.threads} thread{'s' if here.threads != 1 else ''}"
    machine = f"{here.device}{threads}; PyTorch {here.torch}; kornia-tidy {here.version}; {here.date[:10]}"
    figure.text(0.03, 0.02, machine, fontsize=SMALL, color=FAINT)
