"""Overview figure of the library: a scene, its depth, masks, their PSFs over depth, and coded captures."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.figures.depth import depth_at, depth_bar, metres
from kornia_tidy.figures.style import (
    ACCENT,
    DEPTH_COLORS,
    FAINT,
    INK,
    LABEL,
    PHASE_COLORS,
    SMALL,
    TITLE,
    quiet,
    require_matplotlib,
)
from kornia_tidy.masks.base import central_square
from kornia_tidy.modulator.modulator import DwellTimes
from kornia_tidy.optics.thin_lens import ThinLensCamera
from kornia_tidy.psf.psf_bank import PSFBank

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH, HEIGHT = 12.0, 6.6  # inches; 150 dots an inch make 1800 x 990 pixels
MOST_ROWS = 5  # masks drawn


def explain(
    image: Tensor, depth: Tensor, optics: TiDyOptics, coded_first: Tensor, coded_all: Tensor, caption: str = ""
) -> Figure:
    """Draw the overview figure of the library: scene, depth, masks, their PSFs over depth, and coded captures.

    Args:
        image: (3, H, W) or (1, H, W) in [0, 1].
        depth: (1, H, W) in metres.
        optics: the camera with its K masks.
        coded_first: capture with the first mask alone (K = 1), like ``image``.
        coded_all: capture with all masks, like ``image``.
        caption: a line of text below the figure.

    Returns:
        A figure; ``figure.savefig(path, dpi=150)`` makes it 1800 pixels wide.

    Raises:
        ImportError: if matplotlib is missing.
        TypeError: if the camera is not a :class:`~kornia_tidy.optics.thin_lens.ThinLensCamera`, with depth in metres.

    Convention:
        - Each PSF is scaled to its own brightest value and drawn with the square root of its light.
        - PSFs are in the orientation of the image; so are masks.
    """
    require_matplotlib()
    from matplotlib.figure import Figure  # noqa: PLC0415

    camera = optics.camera
    if not isinstance(camera, ThinLensCamera):
        raise TypeError(f"explain needs a ThinLensCamera, whose depths are metres, got {type(camera).__name__}")
    figure = Figure(figsize=(WIDTH, HEIGHT), facecolor="white")
    masks = optics.masks.phase.shape[0]
    _titles(figure, masks)
    _scene(figure, image, depth, camera)
    _table(figure, optics, camera)
    _text(figure, SCENE_X, 0.1, caption, SMALL, color=FAINT)
    _captures(figure, coded_first, coded_all, masks)
    return figure


def single_mask_banks(optics: TiDyOptics, masks: int) -> list[PSFBank]:
    """Return the PSF bank of each of the first masks without the others, in the window of the time-averaged PSFs.

    Example:
        >>> from kornia_tidy import Fidelity, PixelwiseMask
        >>> optics = TiDyOptics(PixelwiseMask(2), fidelity=Fidelity(window=23, layer_spacing=20.0))
        >>> banks = single_mask_banks(optics, 2)
        >>> light = [bank.psfs * bank.energy[..., None, None] for bank in (*banks, optics.psf_bank())]
        >>> torch.allclose((light[0] + light[1]) / 2, light[2], atol=1e-6)
        True
    """
    count = optics.masks.phase.shape[0]
    alone = TiDyOptics(
        optics.masks,
        camera=optics.camera,
        fidelity=optics.fidelity.replace(window=optics.window),
        color_space=optics.color_space,
        spectrum=optics.spectrum,
        aperture=optics.aperture,
    )
    banks = []
    with torch.no_grad():
        for k in range(masks):
            alone.modulator = DwellTimes([float(k == other) for other in range(count)])
            banks.append(alone.psf_bank())
    return banks


# ---------------------------------------------------------------------- the four parts, from left to right

# Positions in inches from the lower left corner of the figure.
SCENE_X, PICTURE = 0.3, 2.3  # left edge, side of the box that holds a picture
TABLE_X, CELL, STEP, GAP = 3.3, 0.56, 0.605, 0.55  # a row of the table is a mask and its PSFs
CAPTURE_X = 9.4
UPPER, LOWER = 3.23, 0.62  # lower edges of the two rows of pictures
ROWS_TOP, AVERAGE_Y = 4.9, 0.72  # upper edge of the first row, lower edge of the last
COLUMNS = 7


def _titles(figure: Figure, masks: int) -> None:
    _text(figure, SCENE_X, 6.29, "One exposure, several phase masks", 14, weight="bold")
    subtitle = "how kornia_tidy's programmable camera writes the depth of a scene into a picture"
    _text(figure, SCENE_X, 6.07, subtitle, TITLE, color=FAINT)
    steps = (
        (SCENE_X, "1  A scene and its depth"),
        (TABLE_X, "2  Masks"),
        (TABLE_X + CELL + GAP, "3  Point spread functions (PSFs) over depth"),
        (CAPTURE_X, "4  Coded captures"),
    )
    for x, text in steps:
        _text(figure, x, 5.79, text, TITLE, weight="bold", color=ACCENT)


def _scene(figure: Figure, image: Tensor, depth: Tensor, camera: ThinLensCamera) -> None:
    from matplotlib import colormaps  # noqa: PLC0415

    _picture(figure, (SCENE_X, UPPER), image, "all in focus, as the eye sees it")
    lo, hi = camera.defocus_range
    inverse_depth = ((camera.defocus(depth) - lo) / (hi - lo)).clamp(0, 1)
    colors = torch.from_numpy(colormaps[DEPTH_COLORS](inverse_depth[0].cpu().numpy())).permute(2, 0, 1)
    axes = _picture(figure, (SCENE_X, LOWER), colors, "its depth; bright is near")
    bounds = axes.get_position(original=False)  # of the picture, not of its box
    depth_bar(figure.add_axes((bounds.x0, 0.44 / HEIGHT, bounds.width, 0.09 / HEIGHT)), camera)


def _table(figure: Figure, optics: TiDyOptics, camera: ThinLensCamera) -> None:
    masks = optics.masks.phase.shape[0]
    shown = min(masks, MOST_ROWS)
    with torch.no_grad():
        average = optics.psf_bank()
    columns = torch.linspace(len(average.defocus) - 1, 0, COLUMNS).round().long().tolist()  # nearest first
    psf_x = [TABLE_X + CELL + GAP + STEP * c for c in range(COLUMNS)]
    right = psf_x[-1] + CELL

    _text(figure, TABLE_X, 5.6, f"{masks} in turn", LABEL, color=FAINT)
    _text(
        figure,
        psf_x[0],
        5.6,
        "what a point of white light becomes on the sensor; a plain lens is sharpest at ψ = 0",
        LABEL,
        color=FAINT,
    )
    for x, node in zip(psf_x, columns, strict=True):
        _column_header(figure, x, float(average.defocus[node]), camera)

    for row, bank in enumerate(single_mask_banks(optics, shown)):
        y = ROWS_TOP - CELL - STEP * row
        _mask(figure, TABLE_X, y, optics, row)
        for x, node in zip(psf_x, columns, strict=True):
            _psf(figure, x, y, bank.psfs[node])
    for x, node in zip(psf_x, columns, strict=True):
        _psf(figure, x, AVERAGE_Y, average.psfs[node])

    first_y, last_y = ROWS_TOP - CELL, ROWS_TOP - CELL - STEP * (shown - 1)
    _arrow(figure, (TABLE_X - 0.16, ROWS_TOP), (TABLE_X - 0.16, last_y), FAINT)
    _text(
        figure,
        TABLE_X - 0.3,
        (ROWS_TOP + last_y) / 2,
        "time, one exposure",
        LABEL,
        color=FAINT,
        rotation=90,
        center=True,
    )
    between = (UPPER + LOWER + PICTURE) / 2
    _arrow(figure, (SCENE_X + PICTURE + 0.06, between), (TABLE_X - 0.42, between), ACCENT)
    _frame(figure, (TABLE_X - 0.06, first_y - 0.035), (right + 0.06, ROWS_TOP + 0.035))
    _frame(figure, (psf_x[0] - 0.06, AVERAGE_Y - 0.06), (right + 0.06, AVERAGE_Y + CELL + 0.06))
    _arrow(figure, (right + 0.1, first_y + CELL / 2), (CAPTURE_X - 0.06, first_y + CELL / 2), ACCENT)
    _arrow(figure, (right + 0.1, AVERAGE_Y + CELL / 2), (CAPTURE_X - 0.06, AVERAGE_Y + CELL / 2), ACCENT)
    gap = (last_y + AVERAGE_Y + CELL) / 2
    middle = psf_x[0] + CELL / 2
    _arrow(figure, (middle, last_y - 0.06), (middle, AVERAGE_Y + CELL + 0.1), ACCENT)
    words = f"the shutter stays open, so the sensor adds up all {masks}" + (f", {shown} shown" if shown < masks else "")
    _text(figure, psf_x[1], gap - 0.04, words, LABEL, color=ACCENT)
    for y, k in ((first_y, 1), (AVERAGE_Y, masks)):
        _text(
            figure, (right + CAPTURE_X) / 2, y + CELL / 2 + 0.11, f"K = {k}", LABEL, ACCENT, center=True, weight="bold"
        )
    _text(figure, TABLE_X + CELL / 2, AVERAGE_Y + CELL / 2, f"average\nof {masks}", LABEL, weight="bold", center=True)
    _phase_bar(figure)


def _captures(figure: Figure, coded_first: Tensor, coded_all: Tensor, masks: int) -> None:
    _picture(figure, (CAPTURE_X, UPPER), coded_first, "K = 1: the first mask all the time")
    _picture(figure, (CAPTURE_X, LOWER), coded_all, f"K = {masks}: all {masks} masks, 1/{masks} of the time each")


# ---------------------------------------------------------------------- pieces


def _column_header(figure: Figure, x: float, defocus: float, camera: ThinLensCamera) -> None:
    from matplotlib import colormaps  # noqa: PLC0415

    lo, hi = camera.defocus_range
    color = colormaps[DEPTH_COLORS]((defocus - lo) / (hi - lo))
    _rectangle(figure, (x, 4.99), (x + CELL, 5.05), facecolor=color, linewidth=0)
    _text(figure, x + CELL / 2, 5.36, f"{metres(depth_at(defocus, camera))} m", LABEL, weight="bold", center=True)
    psi = "0" if abs(defocus) < 0.05 else f"{defocus:+.2g}".replace("-", "\N{MINUS SIGN}")
    _text(figure, x + CELL / 2, 5.17, f"ψ = {psi}", SMALL, color=FAINT, center=True)


def _mask(figure: Figure, x: float, y: float, optics: TiDyOptics, k: int) -> None:
    phase = central_square(optics.masks.phase)[k].detach().cpu().remainder(2 * math.pi)
    amplitude = optics.pupil.transmission
    cells = amplitude.shape[-1] // phase.shape[-1]
    light = torch.nn.functional.avg_pool2d(amplitude[None, None].double(), cells)[0, 0]
    axes = _axes(figure, x, y, CELL)
    axes.imshow(
        phase.where(light > 0, math.nan).numpy(), cmap=PHASE_COLORS, vmin=0, vmax=2 * math.pi, interpolation="nearest"
    )
    quiet(axes)
    axes.text(0.02, 0.98, str(k + 1), fontsize=SMALL, color=INK, va="top", transform=axes.transAxes)


def _phase_bar(figure: Figure) -> None:
    bar = figure.add_axes((TABLE_X / WIDTH, 0.44 / HEIGHT, CELL / WIDTH, 0.09 / HEIGHT))
    bar.imshow(np.linspace(0, 1, 256)[None], cmap=PHASE_COLORS, aspect="auto", extent=(0, 1, 0, 1))
    bar.set_xticks([0, 1], ["0", "2π"])
    quiet(bar, spines=False)
    _text(figure, TABLE_X + CELL + 0.1, 0.45, "phase", SMALL, color=FAINT)


def _psf(figure: Figure, x: float, y: float, psf: Tensor) -> None:
    light = psf.detach().cpu()
    _picture(figure, (x, y), (light / light.max().clamp(min=1e-30)).sqrt(), side=CELL)


def _picture(
    figure: Figure, corner: tuple[float, float], image: Tensor, title: str = "", side: float = PICTURE
) -> Axes:
    """Draw a picture with a title, fitted into a square; upper pictures align at its top, lower ones at its bottom."""
    x, y = corner
    axes = _axes(figure, x, y, side)
    pixels = image.detach().cpu().clamp(0, 1)
    pixels = pixels.expand(3, -1, -1) if pixels.shape[0] == 1 else pixels
    axes.imshow(pixels.permute(1, 2, 0).numpy(), interpolation="antialiased")
    axes.set_anchor("NW" if y == UPPER else "SW")
    axes.apply_aspect()
    quiet(axes, spines=False)
    _text(figure, x, axes.get_position(original=False).y1 * HEIGHT + 0.07, title, LABEL, color=FAINT)
    return axes


def _axes(figure: Figure, x: float, y: float, side: float) -> Axes:
    return figure.add_axes((x / WIDTH, y / HEIGHT, side / WIDTH, side / HEIGHT))


def _text(
    figure: Figure, x: float, y: float, text: str, size: float, color: str = INK, center: bool = False, **style: Any
) -> None:
    """Write text at a position in inches, left-aligned or centred."""
    ha, va = ("center", "center") if center else ("left", "baseline")
    figure.text(x / WIDTH, y / HEIGHT, text, fontsize=size, color=color, ha=ha, va=va, **style)


def _arrow(figure: Figure, start: tuple[float, float], end: tuple[float, float], color: str) -> None:
    from matplotlib.patches import FancyArrowPatch  # noqa: PLC0415

    (x0, y0), (x1, y1) = start, end
    figure.add_artist(
        FancyArrowPatch(
            (x0 / WIDTH, y0 / HEIGHT),
            (x1 / WIDTH, y1 / HEIGHT),
            arrowstyle="-|>",
            mutation_scale=9,
            linewidth=1.2,
            color=color,
            shrinkA=0,
            shrinkB=0,
        )
    )


def _frame(figure: Figure, lower: tuple[float, float], upper: tuple[float, float]) -> None:
    _rectangle(figure, lower, upper, fill=False, linewidth=1.2, edgecolor=ACCENT)


def _rectangle(figure: Figure, lower: tuple[float, float], upper: tuple[float, float], **style: Any) -> None:
    from matplotlib.patches import Rectangle  # noqa: PLC0415

    (x0, y0), (x1, y1) = lower, upper
    figure.add_artist(Rectangle((x0 / WIDTH, y0 / HEIGHT), (x1 - x0) / WIDTH, (y1 - y0) / HEIGHT, **style))
