"""Figure of published systems side by side: masks, and PSFs, contrast and depth bounds over depth, and captures."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.figures.depth import depth_at, depth_colors
from kornia_tidy.figures.style import ACCENT, FAINT, INK, LABEL, PHASE_COLORS, SMALL, TITLE, new_figure
from kornia_tidy.figures.system_statistics import SystemStatistics
from kornia_tidy.masks.base import central_square
from kornia_tidy.optics.published_systems import System
from kornia_tidy.optics.thin_lens import ThinLensCamera

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

PSFS = 7  # of a system
WIDTHS = (2.5, 1, *(1,) * PSFS, 0.2, 1.9, 0.2, 1.9, 1.6)  # inches of the columns; two are gaps for the labels of charts
MASK, PSF, CONTRAST, BOUND, CAPTURE = 1, 2, 3 + PSFS, 5 + PSFS, 6 + PSFS  # columns
TITLES = {
    MASK: "Mask\nphase, 0 to 2π",
    PSF: "Point spread functions over depth",
    CONTRAST: "Contrast (MTF)\nof red, green and blue; to ½ cycle a pixel",
    BOUND: "Depth information\nleast error of ψ (√CRLB), rad",
    CAPTURE: "Capture\nwith the system's noise",
}
CAPTION = (
    "Each as its paper or code describes it, with the masks it starts from before training. A PSF is drawn as the "
    "square root of its light, on a scale of its own; the bar is 10 pixels.\n"
    "Depth information: bound of Cramér and Rao on the defocus of a point somewhere in the image, 3000 photons a "
    "channel and 5 a pixel behind it; the other systems in grey.\n"
    "Contrast is averaged over directions and drawn as its square root: white where all colours are sharp. The scene's "
    "depth is stretched, in dioptres, over the range of each system. Near is left."
)


@dataclass(frozen=True)
class Portrait:
    """One row of the figure: a system with its camera, its statistics over defocus, and a capture.

    Args:
        system: entry of the table of systems.
        optics: camera of the system.
        statistics: of the camera over defocus.
        capture: (3, H, W) in [0, 1], of the scene.
    """

    system: System
    optics: TiDyOptics
    statistics: SystemStatistics
    capture: Tensor


def draw_systems(portraits: Sequence[Portrait], image: Tensor, inverse_depth: Tensor, scene: str) -> Figure:
    """Draw one row for each system: mask, PSFs over depth, contrast, depth bound, and the capture of one scene.

    Args:
        portraits: of the systems, from top to bottom.
        image: the scene, (3, H, W) in [0, 1].
        inverse_depth: normalised inverse depth of the scene, (1, H, W): 0 is the farthest and 1 the nearest end of each
            system's range.
        scene: name of the scene.

    Returns:
        A figure; ``figure.savefig(path, dpi=120)`` makes it some 2200 pixels wide.

    Raises:
        ImportError: if matplotlib is missing.
        ValueError: if there are no systems, or the camera of a system has no depth in metres.

    Convention:
        - Each PSF is scaled to its own brightest value and drawn with the square root of its light; the bar is 10 px.
        - Near is left everywhere. Contrast is drawn as a colour, with the contrast of the channels as red, green, blue.
    """
    if not portraits:
        raise ValueError("there is nothing to draw: no systems were given")
    rows = len(portraits) + 1
    figure = new_figure(sum(WIDTHS) + 1, 1.35 * rows + 0.7)
    figure.suptitle("Published optical systems, side by side", size=1.7 * TITLE, weight="bold", color=INK)
    figure.supxlabel(CAPTION, size=LABEL, color=FAINT, x=0.01, ha="left")
    places = figure.subplots(rows, len(WIDTHS), width_ratios=WIDTHS, squeeze=False)
    for axes in places.flat:
        axes.set_axis_off()
    values = np.concatenate([portrait.statistics.bound.numpy() for portrait in portraits])
    for row, (portrait, axes) in enumerate(zip(portraits, places[:-1], strict=True)):
        _words(axes[0], portrait)
        _mask(axes[MASK], portrait.optics)
        _psfs(axes[PSF : PSF + PSFS], portrait)
        _contrast(axes[CONTRAST], portrait)
        for other in portraits:
            near_first = other.statistics.defocus.flip(0)
            place = (near_first - near_first[0]) / (near_first[-1] - near_first[0])
            own = {"color": ACCENT, "linewidth": 1.8, "zorder": 3} if other is portrait else {"color": "#d3dae1"}
            axes[BOUND].plot(place, other.statistics.bound.flip(0), **own)
        axes[BOUND].set_yscale("log")
        # The bound of a plain lens is infinite in focus.
        axes[BOUND].set_ylim(float(values.min()) / 1.4, float(np.quantile(values, 0.95)) * 1.8)
        for chart in (axes[CONTRAST], axes[BOUND]):
            chart.set_axis_on()
            chart.tick_params(labelsize=SMALL, which="both")
            chart.set_xticks([0, 1], ["near", "far"] if row == len(portraits) - 1 else ["", ""])
        _picture(axes[CAPTURE], portrait.capture)
    for column, words in TITLES.items():
        places[0, column].set_title(words, size=LABEL, color=ACCENT, loc="left")
    for axes, picture, words in (
        (places[-1, BOUND], image, f"the scene: {scene}"),
        (places[-1, CAPTURE], depth_colors(inverse_depth), "its depth, bright is near"),
    ):
        _picture(axes, picture)
        axes.set_title(words, size=SMALL, color=FAINT)
    return figure


def _words(axes: Axes, portrait: Portrait) -> None:
    system, camera = portrait.system, _metric(portrait.optics)
    lens = f"{camera.focal_length * 1e3:.3g} mm f/{camera.f_number:.3g}, {camera.pixel_pitch * 1e6:.3g} µm pixels"
    lines = [f"{system.year}: {system.paper.split(': ')[1]}", f"{lens}, {system.compositing}", system.known_for]
    if system.guesses:
        lines.append("guessed: " + ", ".join(system.guesses))
    axes.text(0, 1, system.title, size=TITLE, weight="bold", color=INK, va="top")
    short = [textwrap.fill(textwrap.shorten(line, 90, placeholder=" …"), 48) for line in lines]
    axes.text(0, 0.82, "\n".join(short), size=SMALL, color=FAINT, va="top")


def _mask(axes: Axes, optics: TiDyOptics) -> None:
    """Draw the phase of the masks, several as the tiles of a square."""
    phase = central_square(optics.masks.phase).detach().cpu().remainder(2 * math.pi)
    amplitude = optics.pupil.transmission
    light = torch.nn.functional.avg_pool2d(amplitude[None, None].double(), amplitude.shape[-1] // phase.shape[-1])
    side = math.ceil(math.sqrt(len(phase)))
    tiles = phase.new_full((side * side, *phase.shape[1:]), math.nan)
    tiles[: len(phase)] = phase.where(light[0] > 0, math.nan)
    square = tiles.unflatten(0, (side, side)).transpose(1, 2).flatten(2, 3).flatten(0, 1)
    axes.imshow(square.numpy(), cmap=PHASE_COLORS, vmin=0, vmax=2 * math.pi, interpolation="nearest")


def _psfs(places: Sequence[Axes], portrait: Portrait) -> None:
    camera, psfs = _metric(portrait.optics), portrait.statistics.psfs
    side = psfs.shape[-1]
    nodes = torch.linspace(len(psfs) - 1, 0, PSFS).round().long().tolist()  # nearest first
    for axes, node in zip(places, nodes, strict=True):
        light = psfs[node].clamp(min=0)
        _picture(axes, (light / light.amax()).sqrt())
        psi = float(portrait.statistics.defocus[node])
        depth = depth_at(psi, camera)
        metres = "∞" if math.isinf(depth) or depth > 100 else f"{depth:.2g} m"
        axes.text(0.5, -0.03, f"{metres}   ψ = {round(psi):+d}", size=SMALL, color=FAINT, ha="center", va="top",
                  transform=axes.transAxes)  # fmt: skip
    places[0].plot([0.06 * side, 0.06 * side + 10], [0.93 * side] * 2, color="white", linewidth=1.5)


def _contrast(axes: Axes, portrait: Portrait) -> None:
    picture = portrait.statistics.contrast.flip(0).permute(2, 0, 1).clamp(0, 1).sqrt()  # (F, D, C), near left
    axes.imshow(picture.numpy(), origin="lower", aspect="auto", extent=(0, 1, 0, 0.5), interpolation="bilinear")


def _metric(optics: TiDyOptics) -> ThinLensCamera:
    if not isinstance(optics.camera, ThinLensCamera):
        raise ValueError(f"a picture of systems needs lenses that know metres, got {type(optics.camera).__name__}")
    return optics.camera


def _picture(axes: Axes, image: Tensor) -> None:
    axes.imshow(image.detach().cpu().clamp(0, 1).permute(1, 2, 0).numpy(), interpolation="nearest")
