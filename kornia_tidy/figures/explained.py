"""Overview figure of the library: a scene, its depth, masks, their PSFs over depth, and coded captures."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.figures.depth import depth_at, depth_bar, depth_colors, metres
from kornia_tidy.figures.style import ACCENT, FAINT, INK, LABEL, PHASE_COLORS, SMALL, TITLE, new_figure, quiet
from kornia_tidy.masks.base import central_square
from kornia_tidy.optics.thin_lens import ThinLensCamera

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure, SubFigure

WIDTH, HEIGHT = 12.0, 6.6  # inches; 150 dots an inch make 1800 x 990 pixels
MOST_ROWS, COLUMNS = 5, 7  # masks drawn, PSFs of each
ABOUT = "how kornia_tidy's programmable camera writes the depth of a scene into a picture"


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
    camera = optics.camera
    if not isinstance(camera, ThinLensCamera):
        raise TypeError(f"explain needs a ThinLensCamera, whose depths are metres, got {type(camera).__name__}")
    figure = new_figure(WIDTH, HEIGHT)
    figure.suptitle(f"One exposure, several phase masks: {ABOUT}", size=TITLE, weight="bold", color=INK)
    figure.supxlabel(caption, size=SMALL, color=FAINT)
    parts: Any = figure.subfigures(1, 3, width_ratios=(2.3, 5.6, 2.3))
    masks = optics.masks.phase.shape[0]
    left, right = parts[0].subplots(3, 1, height_ratios=(1, 1, 0.05)), parts[2].subplots(2, 1)
    parts[0].suptitle("1  A scene and its depth", size=TITLE, color=ACCENT)
    _picture(left[0], image, "all in focus, as the eye sees it")
    lo, hi = camera.defocus_range
    _picture(left[1], depth_colors((camera.defocus(depth) - lo) / (hi - lo)), "its depth; bright is near")
    depth_bar(left[2], camera)
    words = "2  Masks     3  Point spread functions (PSFs) over depth, near to far"
    parts[1].suptitle(words, size=TITLE, color=ACCENT)
    draw_masks_and_psfs(parts[1], optics, camera)
    parts[2].suptitle("4  Coded captures", size=TITLE, color=ACCENT)
    _picture(right[0], coded_first, "K = 1: the first mask all the time")
    _picture(right[1], coded_all, f"K = {masks}: all {masks} masks, 1/{masks} of the time each")
    return figure


def draw_masks_and_psfs(part: Figure | SubFigure, optics: TiDyOptics, camera: ThinLensCamera) -> None:
    """Draw a row for each mask with its PSFs over depth, near to far, and a last one with their average.

    Convention:
        Each PSF is drawn as the root of its light, on its own scale. Five masks at most are shown, and of measured PSFs
        the average only.
    """
    phase = central_square(optics.masks.phase).detach().cpu().remainder(2 * math.pi)
    shown = min(len(phase), MOST_ROWS) if optics.psf_model.measured is None else 0
    lo, hi = camera.defocus_range
    defocus = torch.linspace(hi, lo, COLUMNS, dtype=torch.float64).tolist()
    with torch.no_grad():
        cameras = [*(optics.through_state(k) for k in range(shown if len(phase) > 1 else 0)), optics]
        psfs = [one.psf_bank(defocus=defocus[::-1]).psfs.flip(0).cpu() for one in cameras]
    more = f", {shown} shown" if shown < len(phase) else ""
    adds = f"the shutter stays open, so the sensor adds up all {len(phase)} masks{more}; " if len(phase) > 1 else ""
    part.supxlabel(f"{adds}phase: dark 0, light π, dark 2π", size=SMALL, color=FAINT)
    axes = part.subplots()  # one for all pictures: forty axes take longer to draw
    axes.set(xlim=(0, COLUMNS + 1.2), ylim=(len(psfs), -0.5))
    axes.set_axis_off()
    middle: dict[str, Any] = {"ha": "center", "va": "center"}
    for column, psi in enumerate(defocus):
        sign = f"{round(psi):+d}" if round(psi) else "0"
        words = f"{metres(depth_at(psi, camera))} m\nψ = {sign}"
        axes.text(column + 1.65, -0.25, words, size=LABEL, color=INK, **middle)
    amplitude = optics.pupil.transmission
    light = torch.nn.functional.avg_pool2d(amplitude[None, None].double(), amplitude.shape[-1] // phase.shape[-1])[0, 0]
    for row, own in enumerate(psfs):
        if row < shown:
            colors: dict[str, Any] = {"cmap": PHASE_COLORS, "vmin": 0, "vmax": 2 * math.pi, "interpolation": "nearest"}
            axes.imshow(phase[row].where(light > 0, math.nan).numpy(), extent=(0, 0.9, row + 0.9, row), **colors)
        else:
            axes.text(0.45, row + 0.45, f"average\nof {len(phase)}", size=LABEL, weight="bold", **middle)
        for column, psf in enumerate(own):
            pixels = (psf / psf.max().clamp(min=1e-30)).clamp(min=0).sqrt().expand(3, -1, -1).permute(1, 2, 0).numpy()
            axes.imshow(pixels, extent=(column + 1.2, column + 2.1, row + 0.9, row), interpolation="antialiased")


def _picture(axes: Axes, image: Tensor, title: str = "") -> None:
    pixels = image.detach().cpu().clamp(0, 1).expand(3, -1, -1)
    axes.imshow(pixels.permute(1, 2, 0).numpy(), interpolation="antialiased")
    quiet(axes, spines=False)
    if title:
        axes.set_title(title, size=LABEL, color=FAINT)
