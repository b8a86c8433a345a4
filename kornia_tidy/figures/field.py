"""Figure of a lens: PSFs over field, depth and colour beside the spot diagram, and the modulation transfer function."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, cast

import torch
from torch import Tensor

from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.figures.field_measures import (
    FieldMeasures,
    depths_around_focus,
    heights_to_corner,
    measures_over_field,
)
from kornia_tidy.figures.style import BLUE, FAINT, GREEN, INK, RED, new_figure, open_chart, require_matplotlib, shown
from kornia_tidy.masks.no_mask import NoMask
from kornia_tidy.optics.lens.lens import Lens
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH, PLOTS, CELL = 12.8, 3.0, 1.2  # inches
LABEL, SMALL = 9, 8  # pt
PAPER = {"facecolor": "white", "edgecolor": "none", "alpha": 0.75, "pad": 0.5}  # behind words on rays
_CELLS, _PITCH = 23, 8e-6  # of a pupil that a lens's own stop cuts, and of pixels, in metres
HELD = 0.95  # share of the light in the window that a cell of the montage shows


def draw_lens(optics: TiDyOptics | Lens, field: int = 5) -> Figure:
    """Draw the PSFs of a camera with a real lens over field, depth and colour, its spot diagram, and its MTF.

    Args:
        optics: the camera; its masks are in the PSFs and the MTF. A lens is drawn without masks, for pixels of 8 um.
        field: number of heights from the axis to the corner.

    Returns:
        A figure; ``figure.savefig(path, dpi=100)`` makes it 1280 pixels wide.

    Raises:
        ImportError: if matplotlib is missing.
        ValueError: if the camera has no lens, or the heights are missing.

    Convention:
        - The field points lie to the right of the axis. PSFs and rays of a colour are centred on its chief ray.

    Example:
        >>> from kornia_tidy import NoMask
        >>> figure = draw_lens(TiDyOptics(NoMask(), lens="single-50mm", fidelity="draft"), field=2)
        >>> round(100 * figure.get_figwidth())
        1280
    """
    require_matplotlib()
    if isinstance(optics, Lens):
        optics = TiDyOptics(NoMask(_CELLS), optics.camera(_PITCH), sensor=None, lens=optics)
    if optics.lens is None:
        raise ValueError("a lens is drawn of a camera that has one, got none: give it lens='single-50mm' or another")
    heights = heights_to_corner(optics.lens, field)
    return draw_field(measures_over_field(optics, heights, depths_around_focus(optics.camera)), airy_radius(optics))


def airy_radius(optics: TiDyOptics) -> float:
    """Return the radius of the first dark ring of an ideal lens at 530 nm, in pixels."""
    camera = optics.camera
    return 1.22 * REFERENCE_WAVELENGTH / 2 / float(camera.pixel_pitch * camera.aperture_radius / camera.image_distance)


def draw_field(measured: FieldMeasures, airy: float) -> Figure:
    """Draw measured PSFs and rays. See :func:`draw_lens`.

    Args:
        measured: PSFs, contrast and rays.
        airy: radius of the first dark ring of an ideal lens in pixels, drawn around the rays.
    """
    (rows, columns), sides = measured.psfs.shape[:2], _sides(measured)
    tall = CELL * (rows + 1)
    figure = new_figure(WIDTH, tall + PLOTS)
    words = f"field points right of the axis, pixels of {1e6 * measured.pitch:.3g} µm; each colour about its chief ray"
    figure.suptitle(f"{shown(measured.lens)}: {words}", fontsize=LABEL + 2, color=INK)
    above, below = cast("Any", figure.subfigures(2, 1, height_ratios=(tall, PLOTS)))
    parts = {
        "PSFs, square root of the light, grey: beyond the window": _psf,
        "spot diagram, rays without masks, circle: Airy disc at 530 nm": _spots,
    }
    for half, (title, draw) in zip(above.subfigures(1, 2), parts.items(), strict=True):
        half.suptitle(title, fontsize=LABEL + 1, color=INK)
        for f, row in enumerate(half.subplots(rows, columns, squeeze=False)):
            for d, axes in enumerate(row):
                draw(axes, measured, f, d, airy)
                _frame(axes, measured, f, d, sides[d], dark=draw is _psf)
            if draw is _psf:
                _name_row(row[0], measured, f)
    for axes, chart in zip(below.subplots(1, 3), (_over_field, _over_depth, _over_colour), strict=True):
        chart(axes, measured)
        scale = "cycles a pixel; solid: along the field, dashed: across"
        open_chart(axes, SMALL, xlim=(0, 0.5), ylim=(0, 1.02), xlabel=scale, ylabel="contrast")
    return figure


def _sides(measured: FieldMeasures) -> list[float]:
    """Return half the side of the cells of each depth in pixels: it holds the rays and most of the light."""
    found = []
    for d in range(measured.psfs.shape[1]):
        rays = max(float(seen[d].abs().max()) for row in measured.rays for seen in row)
        light = max(_half_side(psf) for psf in measured.psfs[:, d].flatten(0, 1))
        found.append(max(1.1 * rays, light + 0.5, 3.5))
    return found


def _half_side(psf: Tensor) -> int:
    """Return the distance from the centre of a PSF in pixels within which most of its light falls."""
    centre = psf.shape[-1] // 2
    for half in range(centre):
        middle = slice(centre - half, centre + half + 1)
        if float(psf[middle, middle].sum()) >= HELD * float(psf.sum()):
            return half
    return centre


def _psf(axes: Axes, measured: FieldMeasures, f: int, d: int, airy: float) -> None:
    light = measured.psfs[f, d].clamp(min=0)
    half, colours = light.shape[-1] / 2, (light / light.amax()).sqrt()
    shown = colours.movedim(0, -1) if len(light) == 3 else colours.mean(0)
    axes.imshow(shown.numpy(), cmap="gray", vmin=0, vmax=1, extent=(-half, half, half, -half), interpolation="nearest")
    axes.set_facecolor(FAINT)


def _spots(axes: Axes, measured: FieldMeasures, f: int, d: int, airy: float) -> None:
    for seen, color in zip(measured.rays[f], _colors(measured), strict=True):
        y, x = seen[d].T
        axes.plot(x, y, ".", color=color, markersize=2.2, markeredgewidth=0, alpha=0.7)
    turn = torch.linspace(0, 2 * math.pi, 100)
    axes.plot(airy * turn.cos(), airy * turn.sin(), color=INK, linewidth=0.7)
    worst = float(measured.spread[f, d].max())
    axes.set_xlabel(f"rms {worst:.2g} px", fontsize=SMALL - 1, color=INK)


def _frame(axes: Axes, measured: FieldMeasures, f: int, d: int, half: float, *, dark: bool) -> None:
    axes.set(xlim=(-half, half), ylim=(half, -half), xticks=[], yticks=[], aspect="equal")
    for spine in axes.spines.values():
        spine.set(color=FAINT, linewidth=0.5)
    if f:
        return
    psi = measured.defocus[d]
    title = f"{measured.depths[d]}\nψ {psi:+.3g} rad" if psi else f"{measured.depths[d]}\nin focus"
    axes.set_title(title, fontsize=LABEL, color=INK, pad=4)
    length = next(step for step in (50, 20, 10, 5, 2, 1) if step <= 0.7 * half or step == 1)
    color = "white" if dark else INK
    axes.plot([-0.88 * half, -0.88 * half + length], [0.86 * half] * 2, color=color, linewidth=2)
    axes.text(-0.88 * half, 0.76 * half, f"{length} px", color=color, fontsize=SMALL, bbox=None if dark else PAPER)


def _name_row(axes: Axes, measured: FieldMeasures, f: int) -> None:
    height, light = measured.heights[f], 100 * float(measured.light[f].mean())
    words = f"{1e3 * height:.3g} mm\n{height / measured.pitch:.0f} px" if height else "axis"
    axes.set_ylabel(f"{words}\nlight {light:.0f} %", fontsize=LABEL, color=INK, rotation=0, ha="right", va="center")


def _over_field(axes: Axes, measured: FieldMeasures) -> None:
    d, c = _focus(measured), len(measured.channels) // 2
    for f, color in enumerate(_shades(len(measured.heights))):
        _pair(axes, measured, (f, d, c), color, f"{1e3 * measured.heights[f]:.3g} mm")
    axes.set_title(f"MTF over the field, {measured.depths[d]}, {measured.channels[c]}")


def _over_depth(axes: Axes, measured: FieldMeasures) -> None:
    c = len(measured.channels) // 2
    for d, color in enumerate(_shades(len(measured.depths))):
        _pair(axes, measured, (-1, d, c), color, measured.depths[d])
    axes.set_title(f"MTF over depth, {1e3 * measured.heights[-1]:.3g} mm off the axis, {measured.channels[c]}")


def _over_colour(axes: Axes, measured: FieldMeasures) -> None:
    d = _focus(measured)
    for c, color in enumerate(_colors(measured)):
        shift = round(float(measured.lateral[-1, c]), 2) + 0.0  # without a negative zero
        _pair(axes, measured, (-1, d, c), color, f"{measured.channels[c]}, lateral {shift:+.2f} px")
    axes.set_title(f"MTF over colour, {1e3 * measured.heights[-1]:.3g} mm off the axis, {measured.depths[d]}")


def _pair(axes: Axes, measured: FieldMeasures, at: tuple[int, int, int], color: Any, label: str) -> None:
    for contrast, dashes in ((measured.tangential, "-"), (measured.sagittal, (0, (4, 2)))):
        frequency = torch.linspace(0, 0.5, contrast.shape[-1])
        axes.plot(frequency, contrast[at], color=color, linewidth=1.4, linestyle=dashes, label=label)
        label = "_"


def _focus(measured: FieldMeasures) -> int:
    return min(range(len(measured.defocus)), key=lambda d: abs(measured.defocus[d]))


def _colors(measured: FieldMeasures) -> Sequence[Any]:
    return (RED, GREEN, BLUE) if len(measured.channels) == 3 else _shades(len(measured.channels))


def _shades(count: int) -> list[Any]:
    from matplotlib import colormaps  # noqa: PLC0415

    return [colormaps["viridis"](0.85 * index / max(count - 1, 1)) for index in range(count)]
