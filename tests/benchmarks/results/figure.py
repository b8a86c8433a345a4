"""Figure of the results on real scenes: PSNR over the noise, and over the f-number at equal exposure time."""

from __future__ import annotations

from typing import TYPE_CHECKING

from kornia_tidy.figures.style import ACCENT, BLUE, FAINT, GREEN, INK, open_chart
from tests.benchmarks.results.captures import FIXED, PHYSICAL
from tests.benchmarks.results.report import reference_row
from tests.benchmarks.results.restorations import NETWORK
from tests.benchmarks.results.table import Key, Results
from tests.benchmarks.results.verdicts import FIVE, ONE, REAL

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLORS = {FIVE: ACCENT, ONE: BLUE}
LIGHTS = dict(zip(PHYSICAL, (INK, ACCENT, BLUE, GREEN), strict=True))
LABEL, SMALL, TITLE = 8, 7, 9  # pt


def draw_results(results: Results, scenes: str = REAL) -> Figure:
    """Draw half B of a set of scenes; bars are standard errors of the differences to the reference of the tables."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 4.2), facecolor="white", layout="constrained")
    left, right = figure.subplots(1, 2)
    _over_noise(left, results, scenes)
    _over_f_number(right, results, scenes)
    for axes in (left, right):
        open_chart(axes, SMALL)
        axes.set_ylabel("PSNR, dB", fontsize=LABEL, color=INK)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(fontsize=SMALL, frameon=False, handlelength=3.5)
        else:
            axes.text(0.5, 0.5, "not measured", transform=axes.transAxes, fontsize=LABEL, color=FAINT, ha="center")
            axes.set(xticks=[], yticks=[])
    return figure


def _over_noise(axes: Axes, results: Results, scenes: str) -> None:
    """The best closed form and the network of each system with a network, and the best flat lens."""
    names = [name for name in COLORS if any(key.system == name for key in results.rows)]
    for name in names:
        for network, style in ((NETWORK, "-"), (None, "--")):
            keys = [
                results.keys(scenes, n, system=name, restoration=network, network=network is not None) for n in FIXED
            ]
            rows = [results.best(each) for each in keys]
            label = f"{name}, {network or 'best closed form'}"
            _line(axes, results, [(float(row.noise), row) for row in rows if row], COLORS[name], style, label)
    flat = [name for name, row in results.systems.items() if row.kind == "flat"]
    rows = [
        results.best([key for key in results.keys(scenes, noise, network=False) if key.system in flat])
        for noise in FIXED
    ]
    found = [(float(row.noise), row) for row in rows if row]
    label = "best flat lens at the same noise, best closed form"
    _line(axes, results, found, GREEN, ":", label)
    axes.set_xscale("log")
    axes.set_xticks([float(noise) for noise in FIXED], FIXED)
    axes.minorticks_off()
    axes.set_xlabel("noise, of full scale", fontsize=LABEL, color=INK)
    axes.set_title("Fixed noise", fontsize=TITLE, color=INK, loc="left")


def _over_f_number(axes: Axes, results: Results, scenes: str) -> None:
    """Flat lenses and coded cameras with their networks and best closed forms; each name stands above its marks."""
    highest: dict[str, tuple[float, float]] = {}
    for name, row in results.systems.items():
        if row.kind not in {"flat", "coded"}:
            continue
        for noise, color in LIGHTS.items():
            for network, mark, face in ((NETWORK, "D", color), (None, "s", "white")):
                keys = results.keys(scenes, noise, system=name, restoration=network, network=network is not None)
                best = results.best(keys)
                if best is None:
                    continue
                mean = results.mean(best, "psnr")
                axes.plot([row.f_number], [mean], mark, color=color, markerfacecolor=face, markersize=5)
                highest[name] = max(highest.get(name, (row.f_number, mean)), (row.f_number, mean))
    for name, place in highest.items():
        axes.annotate(name, place, (0, 7), textcoords="offset points", fontsize=SMALL, color=INK, ha="center")
    if highest:
        for noise, color in LIGHTS.items():
            axes.plot([], [], "o", color=color, markersize=5, label=f"{int(noise[:-1]):,} electrons")
        axes.plot([], [], "D", color=FAINT, markersize=5, label="network")
        axes.plot([], [], "s", color=FAINT, markerfacecolor="white", markersize=5, label="best closed form")
    axes.margins(x=0.12, y=0.1)
    axes.set_xlabel("f-number", fontsize=LABEL, color=INK)
    axes.set_title("Equal exposure time", fontsize=TITLE, color=INK, loc="left")


def _line(axes: Axes, results: Results, points: list[tuple[float, Key]], color: str, style: str, label: str) -> None:
    if not points:
        return
    errors = []
    for _, key in points:
        reference = reference_row(results, key.scenes, key.noise)
        own = key == reference or reference is None
        errors.append(0.0 if own else results.difference(key, reference).error)
    places, means = [place for place, _ in points], [results.mean(key, "psnr") for _, key in points]
    axes.errorbar(places, means, errors, color=color, linestyle=style, marker="o", markersize=3, label=label, capsize=2)
