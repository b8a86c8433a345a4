"""Figure of the speed-accuracy trade-off: error over time, a line for each swept setting, and the Pareto front."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from kornia_tidy.design.tradeoff.files import TradeRun, value_in_words
from kornia_tidy.design.tradeoff.measure import TradeRow, pareto
from kornia_tidy.design.tradeoff.sweep_settings import PLAN, PRESET, SWEEP_VALUES
from kornia_tidy.figures.style import FAINT, INK, open_chart, require_matplotlib

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Label = tuple[str, tuple[float, float], str, float]  # text, time in ms and error, colour, size in pt

# Okabe and Ito's colours for colour-blind readers, without the yellow, which is invisible on white.
COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#7a5195")
MARKERS = ("o", "s", "^", "v", "D", "P", "X")
FRONT = "#c9d3dc"
TITLE, LABEL, SMALL = 12, 9, 7.5  # pt
WIDTH, HEIGHT = 10.0, 6.2  # inches
GAP = 3.0  # an error of zero is drawn at the smallest other error divided by this
OFFSETS = ((6, 5), (6, -11), (-6, 5), (-6, -11), (0, 9), (0, -15), (10, -3), (-10, -3), (14, 12), (-14, 12), (14, -18))


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
    require_matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure(figsize=(WIDTH, HEIGHT), facecolor="white")
    FigureCanvasAgg(figure)
    axes = figure.add_axes((0.085, 0.125, 0.685, 0.735))
    floor = min((row.rmse for row in run.rows if row.rmse > 0), default=1.0) / GAP
    _frame(axes, run, floor)
    _front(axes, run.rows, floor)
    labels: list[Label] = []
    for number, knob in enumerate(name for name in SWEEP_VALUES if name != PRESET):
        steps = [row for row in run.rows if row.knob == knob]
        if len({(row.capture_seconds, row.rmse) for row in steps}) > 1:
            labels += _knob(axes, steps, floor, number)
    plans = [row for row in run.rows if row.knob == PLAN]
    labels = (_plans(axes, plans, floor) if plans else []) + labels  # the first labels get the room
    presets = [row for row in run.rows if row.knob == PRESET]
    _presets(axes, presets, floor)
    _titles(figure, run)
    figure.legend(loc="upper left", bbox_to_anchor=(0.782, 0.868), fontsize=LABEL, frameon=False, labelspacing=0.75)
    names = [(str(row.value), _place(row, floor), INK, LABEL) for row in presets]
    at_presets = {place for _, place, _, _ in names}
    _label(axes, names + [label for label in labels if label[1] not in at_presets])
    return figure


def _place(row: TradeRow, floor: float) -> tuple[float, float]:
    return 1e3 * row.capture_seconds, max(row.rmse, floor)


def _frame(axes: Axes, run: TradeRun, floor: float) -> None:
    times = [1e3 * row.capture_seconds for row in run.rows]
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlim(min(times) / 1.35, max(times) * 1.5)
    axes.set_ylim(floor / 1.6, 2 * max(2 * floor, *(row.rmse for row in run.rows)))
    axes.set_xlabel("time of a capture, PSF bank and rendering, ms", fontsize=LABEL, color=INK)
    axes.set_ylabel("error: RMSE of the noise-free linear capture, full scale 1", fontsize=LABEL, color=INK)
    open_chart(axes, LABEL)
    axes.xaxis.set_major_formatter(_plain)
    axes.xaxis.set_minor_formatter(_minor(math.log10(max(times) / min(times))))
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


def _plain(value: float, _: Any = None) -> str:
    return f"{value:g}"


def _minor(decades: float) -> Any:
    """Return a formatter that labels 2 and 5 between powers of ten, unless the axis spans many decades."""
    wanted = (2, 5) if decades < 2.5 else ()
    return lambda value, _=None: (
        f"{value:g}" if round(value / 10 ** math.floor(math.log10(value) + 1e-9)) in wanted else ""
    )


def _front(axes: Axes, rows: Sequence[TradeRow], floor: float) -> None:
    places = [_place(row, floor) for row in pareto(rows)]
    x, y = [place[0] for place in places], [place[1] for place in places]
    # The front is extended straight beyond its ends: no row is faster on the left or more accurate on the right.
    x, y = [x[0], *x, axes.get_xlim()[1]], [axes.get_ylim()[1], *y, y[-1]]
    axes.step(x, y, where="post", color=FRONT, linewidth=5, solid_joinstyle="round", zorder=1.5, label="Pareto front")


def _knob(axes: Axes, steps: list[TradeRow], floor: float, number: int) -> list[Label]:
    color = COLORS[number % len(COLORS)]
    steps = sorted(steps, key=_order)
    places = [_place(row, floor) for row in steps]
    axes.plot(
        *zip(*places, strict=True),
        color=color,
        marker=MARKERS[number % len(MARKERS)],
        markersize=5,
        markeredgecolor="white",
        markeredgewidth=0.6,
        linewidth=1.3,
        label=steps[0].knob,
        zorder=3,
    )
    return [
        (value_in_words(row).removesuffix(", measured"), place, color, SMALL)
        for row, place in zip(steps, places, strict=True)
    ]


def _plans(axes: Axes, plans: list[TradeRow], floor: float) -> list[Label]:
    """Draw a heavy line through the plans, and return labels with their tolerances."""
    plans = sorted(plans, key=_order)
    places = [_place(row, floor) for row in plans]
    x, y = zip(*places, strict=True)
    axes.plot(x, y, color=INK, marker="o", markersize=6, linewidth=2, label="plan, by tolerance", zorder=3.5)
    return [
        (f"{row.value:.0e}".replace("e-0", "e-"), place, INK, SMALL) for row, place in zip(plans, places, strict=True)
    ]


def _order(row: TradeRow) -> float:
    """Return the sort key of a row along its line: the numeric value, or the measured window; 0 for names."""
    value = row.window if row.value is None else row.value
    return 0.0 if isinstance(value, str) else float(value)


def _presets(axes: Axes, presets: list[TradeRow], floor: float) -> None:
    if presets:
        axes.scatter(
            *zip(*(_place(row, floor) for row in presets), strict=True),
            s=150,
            marker="*",
            color=INK,
            edgecolor="white",
            linewidth=0.8,
            label="presets",
            zorder=4,
        )


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


def _label(axes: Axes, labels: list[Label]) -> None:
    """Draw labels beside their points without overlap; labels without room are left out."""
    from matplotlib.patheffects import withStroke  # noqa: PLC0415

    canvas: Any = axes.figure.canvas
    canvas.draw()
    renderer, scale = canvas.get_renderer(), canvas.figure.dpi / 72
    points = [axes.transData.transform(place) for _, place, _, _ in labels]
    taken = [text.get_window_extent(renderer) for text in axes.texts]
    seen = set()
    for text, place, color, size in labels:
        if (text, place) in seen:
            continue
        seen.add((text, place))
        for dx, dy in OFFSETS:
            note = axes.annotate(
                text,
                place,
                (dx, dy),
                textcoords="offset points",
                fontsize=size,
                color=color,
                ha="left" if dx > 0 else "right" if dx < 0 else "center",
                weight="bold" if color == INK else "normal",
                zorder=5,
                path_effects=[withStroke(linewidth=2, foreground="white")],
            )
            box = note.get_window_extent(renderer)
            room = box.expanded(1.02, 1.02)
            hit = any(room.overlaps(other) for other in taken) or any(
                room.x0 - 2 * scale < x < room.x1 + 2 * scale and room.y0 - 2 * scale < y < room.y1 + 2 * scale
                for x, y in points
            )
            inside = axes.bbox.x0 <= box.x0 and box.x1 <= axes.bbox.x1 + 10 and axes.bbox.y0 <= box.y0
            if inside and not hit:
                taken.append(box)
                break
            note.remove()
