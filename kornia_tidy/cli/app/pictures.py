"""Pictures of a result as arrays of bytes: photographs, depth maps with a scale in metres, masks and PSFs."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.cli.app.capture import Result
from kornia_tidy.figures.depth import depth_at, depth_bar, metres
from kornia_tidy.figures.style import DEPTH_COLORS, FAINT, INK, PHASE_COLORS, require_matplotlib
from kornia_tidy.masks.base import central_square
from kornia_tidy.optics.thin_lens import ThinLensCamera

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Picture = NDArray[np.uint8]

DOTS_PER_INCH, DEPTH_WIDTH = 200, 3.2  # a depth map is 640 pixels wide
BAR, BELOW = 0.09, 0.34  # inches: height of the colour bar, room for it and its labels
COLUMNS, MOST_ROWS = 5, 5  # depths of the PSFs; masks shown one by one
CELL, GAP, LEFT = 116, 8, 8  # pixels of the table of masks and PSFs
TITLE, HEAD = 48, 58  # pixels of its title, at whose right a browser puts buttons, and of the depths below it
SCREEN = 100  # dots an inch of the table
MASK_SPACE = 44  # pixels between masks and PSFs


def photograph(image: Tensor) -> Picture:
    """Return an image (3, H, W) in [0, 1] as bytes (H, W, 3).

    Example:
        >>> photograph(torch.tensor([0.0, 0.5, 2.0]).view(3, 1, 1)).tolist()
        [[[0, 128, 255]]]
    """
    return (image.clamp(0, 1) * 255).round().byte().permute(1, 2, 0).contiguous().numpy()


def depth_map(inverse_depth: Tensor, camera: ThinLensCamera) -> Picture:
    """Draw normalised inverse depth (1, H, W) in colours, with a bar of the camera's depth range in metres.

    Raises:
        ImportError: if matplotlib is missing.
    """
    height, width = inverse_depth.shape[-2:]
    rows = DEPTH_WIDTH * height / width
    figure = _figure(DEPTH_WIDTH, rows + BELOW, DOTS_PER_INCH)
    picture = figure.add_axes((0, BELOW / (rows + BELOW), 1, rows / (rows + BELOW)))
    picture.imshow(inverse_depth[0].clamp(0, 1).numpy(), cmap=DEPTH_COLORS, vmin=0, vmax=1, aspect="auto")
    picture.set_axis_off()
    depth_bar(figure.add_axes((0.05, (BELOW - BAR - 0.04) / (rows + BELOW), 0.9, BAR / (rows + BELOW))), camera)
    return _pixels(figure)


@torch.no_grad()
def masks_and_psfs(result: Result) -> Picture:
    """Draw masks and their PSFs over depth as a table: a row for each mask, and one for the average over the exposure.

    Each PSF is scaled to its brightest value and drawn as the root of its light, in red, green and blue; the nearest
    depth is on the left. Masks are in the colours of phase from 0 to 2 pi at 530 nm.

    Raises:
        ImportError: if matplotlib is missing.
    """
    optics = result.optics
    lo, hi = result.camera.defocus_range
    defocus = torch.linspace(lo, hi, COLUMNS, dtype=torch.float64)
    rows = [optics.psf_bank(defocus=defocus.tolist()).psfs.flip(0)]
    masks = mask_colors(optics)
    count, shown = len(masks), min(len(masks), MOST_ROWS)
    if count > 1:
        states = [optics.through_state(k) for k in range(shown)]
        rows = [*(one.psf_bank(defocus=defocus.tolist()).psfs.flip(0) for one in states), *rows]
    first, top = LEFT + CELL + MASK_SPACE, TITLE + HEAD
    canvas = np.ones((top + len(rows) * (CELL + GAP), first + COLUMNS * (CELL + GAP), 3), np.float32)
    for row, psfs in enumerate(rows):
        y = top + row * (CELL + GAP)
        if row < shown:
            canvas[y : y + CELL, LEFT : LEFT + CELL] = masks[row]
        for column, psf in enumerate(psfs):
            x = first + column * (CELL + GAP)
            canvas[y : y + CELL, x : x + CELL] = psf_cell(psf)

    height, width = canvas.shape[:2]
    figure = _figure(width / SCREEN, height / SCREEN, SCREEN)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.imshow(canvas, extent=(0, width, height, 0), interpolation="nearest", aspect="auto")
    axes.set_axis_off()
    axes.text(LEFT, TITLE / 2, "Masks" if count > 1 else "Mask", fontsize=14, color=INK, weight="bold", va="center")
    axes.text(first, TITLE / 2, "A point of light, by its depth", fontsize=14, color=INK, weight="bold", va="center")
    middle: dict[str, Any] = {"ha": "center", "va": "center"}
    for column, psi in enumerate(defocus.flip(0).tolist()):
        x = first + column * (CELL + GAP) + CELL / 2
        depth = f"{metres(depth_at(psi, result.camera))} m"
        axes.text(x, TITLE + 0.32 * HEAD, depth, fontsize=12, color=INK, weight="bold", **middle)
        sign = "0" if abs(psi) < 0.5 else f"{psi:+.0f}".replace("-", "\N{MINUS SIGN}")
        axes.text(x, TITLE + 0.74 * HEAD, f"ψ = {sign}", fontsize=10, color=FAINT, **middle)
    if count > 1:
        words = f"average\nof {count}" + (f"\n({shown} shown)" if shown < count else "")
        y = top + shown * (CELL + GAP) + CELL / 2
        axes.text(LEFT + CELL / 2, y, words, fontsize=12, color=INK, weight="bold", **middle)
    return _pixels(figure)


def psf_cell(psf: Tensor) -> NDArray[np.float32]:
    """Return a PSF (3, P, P) as a cell of the table, (CELL, CELL, 3): the root of its light, 1 at the brightest."""
    light = psf.clamp(min=0)
    light = (light / light.amax().clamp(min=1e-30)).sqrt()
    return interpolate(light[None].float(), (CELL, CELL), mode="nearest")[0].permute(1, 2, 0).numpy()


def mask_colors(optics: TiDyOptics) -> list[NDArray[np.float32]]:
    """Return the masks as cells of the table, in the colours of phase, white where the aperture is shut."""
    require_matplotlib()
    from matplotlib import colormaps  # noqa: PLC0415

    phases = central_square(optics.masks.phase).detach().remainder(2 * math.pi) / (2 * math.pi)
    amplitude = optics.pupil.transmission
    cells = max(1, amplitude.shape[-1] // phases.shape[-1])
    open_ = avg_pool2d(amplitude[None, None].double(), cells)[0, 0] > 0
    found = []
    for phase in phases:
        colors = torch.from_numpy(colormaps[PHASE_COLORS](phase.numpy())[..., :3]).permute(2, 0, 1)
        colors = torch.where(open_, colors, 1.0)
        found.append(interpolate(colors[None], (CELL, CELL), mode="nearest")[0].permute(1, 2, 0).float().numpy())
    return found


def _figure(width: float, height: float, dots_per_inch: int) -> Figure:
    """Return a figure of inches that draws itself into memory."""
    require_matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415
    from matplotlib.figure import Figure  # noqa: PLC0415

    figure = Figure(figsize=(width, height), dpi=dots_per_inch, facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def _pixels(figure: Figure) -> Picture:
    canvas: Any = figure.canvas
    canvas.draw()
    return np.array(canvas.buffer_rgba())[..., :3].copy()
