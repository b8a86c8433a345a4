"""Tables in Markdown and figures of the experiments with a network, from the rows of their results."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path

from examples.paper.runner import Row

NETWORK, CLOSED, START = "network", "closed", "start"
WHERE = ("painted", "real")


def means(rows: Sequence[Row], score: str) -> list[float]:
    """Return a score of each row that has it."""
    return [float(row[score]) for row in rows if score in row]


def cell(rows: Sequence[Row], what: str, task: str) -> str:
    """Return what restored the captures, ``"network"`` for example, as a cell: painted scenes / real scenes."""
    parts = []
    for where in WHERE:
        found = []
        for score in {"edof": ("psnr",), "depth": ("rmse",), "joint": ("psnr", "rmse")}[task]:
            values = means(rows, f"{what}_{where}_{score}")
            if values and score == "rmse":
                scaled = mean_and_error([20 * value for value in values])
                found.append(f"{mean_and_error(values)} ({scaled})")
            elif values:
                found.append(mean_and_error(values))
        if found:
            parts.append(", ".join(found))
    return " / ".join(parts) or "-"


def cells(rows: Sequence[Row], task: str) -> list[str]:
    """Return the cells of network, and of the closed form behind the masks after and before training."""
    return [cell(rows, what, task) for what in (NETWORK, CLOSED, START)]


def grid(heading: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """Return a table in Markdown.

    Example:
        >>> print(grid(["a", "b"], [["1", "2"]]))
        | a | b |
        |---|---|
        | 1 | 2 |
    """
    rows = [heading, *lines]
    made = ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join([made[0], "|" + "---|" * len(heading), *made[1:]])


def bars(panels: Mapping[str, Mapping[str, Mapping[str, Sequence[float]]]], path: Path, below: str) -> None:
    """Draw panels of points with standard errors: by title, by name of the series, by place, the values of the seeds.

    Args:
        panels: what to draw.
        path: of the PNG file.
        below: label of the horizontal axis.
    """
    from matplotlib.figure import Figure  # noqa: PLC0415 (so that --help needs no extra)

    from kornia_tidy.figures.style import ACCENT, FAINT, INK, open_chart  # noqa: PLC0415

    figure = Figure(figsize=(4.2 * len(panels), 3.4), facecolor="white", layout="constrained")
    drawn = zip(figure.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True)
    for axes, (heading, series) in drawn:
        places = list(dict.fromkeys(place for points in series.values() for place in points))
        for turn, (color, (name, points)) in enumerate(zip((ACCENT, INK, FAINT), series.items(), strict=False)):
            kept = [(places.index(place) + 0.12 * (turn - 1), values) for place, values in points.items() if values]
            if not kept:
                continue
            errors = [statistics.stdev(v) / len(v) ** 0.5 if len(v) > 1 else 0.0 for _, v in kept]
            axes.errorbar(
                [x for x, _ in kept], [statistics.fmean(v) for _, v in kept], errors,
                color=color, marker="o", markersize=4, capsize=2, linewidth=0, elinewidth=1.3, label=name,
            )  # fmt: skip
        axes.set_xticks(range(len(places)), places, fontsize=7, rotation=0 if max(map(len, places)) < 9 else 20)
        axes.set_title(heading, fontsize=9, color=INK)
        axes.set_xlabel(below, fontsize=8, color=INK)
        open_chart(axes, 7.5)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(fontsize=7.5, frameon=False)
    figure.savefig(path, dpi=110)


def mean_and_error(values: Sequence[float]) -> str:
    """Return a mean and its standard error over seeds as text; without the error if all values are equal.

    Example:
        >>> mean_and_error([1.0, 2.0, 3.0]), mean_and_error([1.5])
        ('2.00 ± 0.58', '1.50')
    """
    mean = statistics.fmean(values)
    digits = 2 if abs(mean) >= 2 else 4
    if len(set(values)) < 2:
        return f"{mean:.{digits}f}"
    return f"{mean:.{digits}f} ± {statistics.stdev(values) / len(values) ** 0.5:.{digits}f}"
