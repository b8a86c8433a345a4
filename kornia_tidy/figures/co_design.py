"""Figure of a co-design: the search over f-numbers, the scores of simulated captures, masks and PSFs."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch

from kornia_tidy.design.candidates import FLAT, STARTS, Candidate
from kornia_tidy.design.simulated_captures import DECISION, candidate_optics
from kornia_tidy.figures.style import (
    ACCENT,
    DEPTH_COLORS,
    FAINT,
    INK,
    LABEL,
    PHASE_COLORS,
    TITLE,
    new_figure,
    open_chart,
    quiet,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from kornia_tidy.design.co_design import CoDesign

WIDTH, HEIGHT = 11.0, 8.0  # inches
DEPTHS, SIDE = 7, 41  # PSFs drawn, and their side in pixels
MARKERS = {FLAT: "o", STARTS[0]: "^", STARTS[1]: "s", STARTS[2]: "D"}
MOST_MASKS = 7


def draw_co_design(design: CoDesign) -> Figure:
    """Draw a co-design.

    Args:
        design: from :func:`~kornia_tidy.design.co_design.co_design`.

    Returns:
        A figure; ``figure.savefig(path, dpi=150)`` makes it 1650 pixels wide.

    Raises:
        ImportError: if matplotlib is missing.

    Convention:
        - PSFs are those of 530 nm, from far (left) to near, each scaled to its own brightest pixel, linear in the
          square root of the light. Masks are modulo one wave.
    """
    figure = new_figure(WIDTH, HEIGHT, layout=None)
    figure.text(0.03, 0.955, design.words[0].upper() + design.words[1:], fontsize=TITLE + 1.5, color=INK, weight="bold")
    _search(figure.add_axes((0.075, 0.56, 0.39, 0.33)), design)
    _scores(figure.add_axes((0.575, 0.56, 0.39, 0.33)), design)
    _masks(figure, design)
    for row, name in enumerate(("flat", "coded")):
        _psfs(figure, design, getattr(design.verdict, name).candidate, 0.165 - 0.135 * row)
    return figure


def _search(axes: Axes, design: CoDesign) -> None:
    by_depth = design.task.depth_weight == 1
    for start, marker in MARKERS.items():
        own = sorted((one for one in design.candidates if one.start == start), key=lambda one: one.f_number)
        if own:
            values = [one.depth_error if by_depth else one.image_error for one in own]
            color = FAINT if start == FLAT else ACCENT
            label = start if start == FLAT else f"masks, {start}"
            stops = [one.f_number for one in own]
            axes.plot(stops, values, linestyle="", marker=marker, markersize=4.5, color=color, label=label)
    _f_numbers(axes, [one.f_number for one in design.candidates])
    title = "Search: " + ("depth error" if by_depth else "restoration error")
    unit = "of the range" if by_depth else "relative to a uniform image"
    open_chart(axes, LABEL, yscale="log", title=title, ylabel=unit)


def _scores(axes: Axes, design: CoDesign) -> None:
    for is_flat, color, label in ((True, FAINT, "flat lens"), (False, ACCENT, "masks")):
        own = [one for one in design.finalists if one.candidate.is_flat is is_flat]
        points = sorted((one.candidate.f_number, one.score) for one in own)
        axes.plot(*zip(*points, strict=True), marker="o", markersize=4.5, color=color, label=label)
    coded = design.verdict.coded
    flat, error = design.verdict.flat, 2 * design.verdict.standard_error
    axes.errorbar([coded.candidate.f_number], [coded.score], [error], color=ACCENT, capsize=3, linewidth=1.2)
    axes.axhline(flat.score, color=FAINT, linewidth=0.8, linestyle=(0, (4, 3)))
    _f_numbers(axes, [one.candidate.f_number for one in design.finalists])
    title = f"Simulated captures, {design.verdict.scenes} scenes; bar: two standard errors of the gain"
    open_chart(axes, LABEL, title=title, ylabel="mean score after the best closed form, dB")


def _f_numbers(axes: Axes, f_numbers: list[float]) -> None:
    lowest, highest = min(f_numbers) / 1.1, max(f_numbers) * 1.1
    stops = [2 ** (half / 2) for half in range(-2, 21)]
    shown = [stop for stop in stops if lowest <= stop <= highest]
    axes.set(xscale="log", xlim=(lowest, highest), xlabel="f-number")
    axes.set_xticks(shown, [f"{stop:.2g}" for stop in shown])
    axes.set_xticks([], minor=True)


def _masks(figure: Figure, design: CoDesign) -> None:
    phase = design.verdict.coded.candidate.phase
    assert phase is not None
    shown = phase[:MOST_MASKS]
    for number, mask in enumerate(shown):
        axes = figure.add_axes((0.15 + 0.115 * number, 0.32, 0.1, 0.1 * WIDTH / HEIGHT))
        axes.imshow(mask.remainder(2 * math.pi).numpy(), cmap=PHASE_COLORS, vmin=0, vmax=2 * math.pi)
        quiet(axes)
    more = f"\nfirst {MOST_MASKS} of {len(phase)}" if len(phase) > MOST_MASKS else ""
    f_number = design.verdict.coded.candidate.f_number
    figure.text(0.03, 0.385, f"masks\nf/{f_number:.3g}{more}", fontsize=LABEL, color=INK, va="center")


def _psfs(figure: Figure, design: CoDesign, candidate: Candidate, bottom: float) -> None:
    model = candidate_optics(design.task, candidate, DECISION.replace(window=SIDE)).psf_model
    lo, hi = model.camera.defocus_range
    with torch.no_grad():
        psfs = model.psf_bank(1, defocus=torch.linspace(lo, hi, DEPTHS).tolist()).psfs[:, 0]
    for number, psf in enumerate(psfs):
        axes = figure.add_axes((0.15 + 0.115 * number, bottom, 0.085, 0.085 * WIDTH / HEIGHT))
        axes.imshow((psf / psf.max()).clamp(min=0).sqrt().numpy(), cmap=DEPTH_COLORS, vmin=0, vmax=1)
        quiet(axes)
    name = "flat lens" if candidate.is_flat else "masks"
    label = f"PSFs, {name}\nf/{candidate.f_number:.3g}\nfar to near"
    figure.text(0.03, bottom + 0.058, label, fontsize=LABEL, color=INK, va="center")
