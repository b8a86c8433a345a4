"""Pictures of a result as arrays of bytes: photographs, depth maps with a scale in metres, masks and PSFs."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from kornia_tidy.cli.app.capture import Result
from kornia_tidy.figures.depth import depth_bar
from kornia_tidy.figures.explained import MOST_ROWS, draw_masks_and_psfs
from kornia_tidy.figures.style import DEPTH_COLORS, INK, new_figure
from kornia_tidy.optics.thin_lens import ThinLensCamera

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Picture = NDArray[np.uint8]

DOTS_PER_INCH, DEPTH_WIDTH = 200, 3.2  # a depth map is 640 pixels wide
BAR, BELOW = 0.09, 0.34  # inches: height of the colour bar, room for it and its labels
WIDTH, CELL, HEAD = 5.6, 0.67, 0.55  # inches of the table of masks and PSFs, its rows, and above and below them
TITLE = 0.4  # inches of its title, at whose right a browser puts buttons


def photograph(image: Tensor) -> Picture:
    """Return an image (3, H, W) in [0, 1] as bytes (H, W, 3).

    Example:
        >>> import torch
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


def masks_and_psfs(result: Result) -> Picture:
    """Draw masks and their PSFs over depth as a table: a row for each mask, and one for the average over the exposure.

    Raises:
        ImportError: if matplotlib is missing.
    """
    masks = len(result.optics.masks.phase)
    height = CELL * (min(masks, MOST_ROWS) + (masks > 1)) + HEAD + TITLE
    figure = _figure(WIDTH, height, DOTS_PER_INCH)
    figure.subplots_adjust(0.01, 0.06, 0.99, 1 - TITLE / height)
    words = "Masks, and their PSFs over depth" if masks > 1 else "The mask, and its PSFs over depth"
    figure.text(0.02, 1 - TITLE / 2 / height, words, size=10, weight="bold", color=INK, va="center")
    draw_masks_and_psfs(figure, result.optics, result.camera)
    return _pixels(figure)


def _figure(width: float, height: float, dots_per_inch: int) -> Figure:
    """Return a figure of inches that draws itself into memory."""
    figure = new_figure(width, height, layout=None)
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # noqa: PLC0415

    figure.set_dpi(dots_per_inch)
    FigureCanvasAgg(figure)
    return figure


def _pixels(figure: Figure) -> Picture:
    canvas: Any = figure.canvas
    canvas.draw()
    return np.array(canvas.buffer_rgba())[..., :3].copy()
