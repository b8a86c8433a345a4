"""Figure of published systems side by side: masks, and PSFs, contrast and depth bounds over depth, and captures."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.figures.depth import depth_at
from kornia_tidy.figures.style import (
    ACCENT,
    BLUE,
    DEPTH_COLORS,
    FAINT,
    GREEN,
    INK,
    PHASE_COLORS,
    RED,
    require_matplotlib,
)
from kornia_tidy.figures.system_statistics import SystemStatistics
from kornia_tidy.masks.base import central_square
from kornia_tidy.optics.published_systems import System
from kornia_tidy.optics.thin_lens import ThinLensCamera

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

HEADLINE, TITLE, LABEL, SMALL = 17, 10, 7.5, 6.5  # pt
COLUMNS = 7  # PSFs of a system
CHANNELS = (RED, GREEN, BLUE)

# Inches, from the lower left corner; a system is a row.
LEFT, WORDS, CELL, GAP = 0.35, 2.75, 1.0, 0.05
ROW, HEAD, FOOT = 1.27, 1.98, 0.5
PLOT, CAPTURE = 2.0, 1.6
MASK_X = LEFT + WORDS
PSF_X = MASK_X + CELL + 0.28
CONTRAST_X = PSF_X + COLUMNS * (CELL + GAP) + 0.42
BOUND_X = CONTRAST_X + PLOT + 0.55
CAPTURE_X = BOUND_X + PLOT + 0.28
WIDTH = CAPTURE_X + CAPTURE + 0.3


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
    require_matplotlib()
    from matplotlib.figure import Figure  # noqa: PLC0415

    if not portraits:
        raise ValueError("there is nothing to draw: no systems were given")
    height = HEAD + ROW * len(portraits) + FOOT
    figure = Figure(figsize=(WIDTH, height), facecolor="white")
    _head(figure, height, image, inverse_depth, scene)
    bounds = [(_place(p.statistics.defocus), p.statistics.bound.numpy()) for p in portraits]
    values = np.concatenate([bound for _, bound in bounds])
    limits = (
        float(values.min()) / 1.4,
        float(np.quantile(values, 0.95)) * 1.8,
    )  # infinite for a plain lens
    for row, portrait in enumerate(portraits):
        y = height - HEAD - ROW * row - CELL
        if row % 2 == 0:  # every other row has a faint background
            _rectangle(figure, (LEFT - 0.15, y - 0.2), (WIDTH - 0.15, y + CELL + 0.07), facecolor="#f5f7f9", zorder=-2)
        _words(figure, y, portrait)
        _mask(figure, y, portrait.optics)
        _psfs(figure, y, portrait)
        _contrast(figure, y, portrait, last=row == len(portraits) - 1)
        _bound(figure, y, bounds, row, limits, last=row == len(portraits) - 1)
        _picture(figure, (CAPTURE_X, y, CAPTURE, CELL), portrait.capture)
    words = (
        "Depth information: bound of Cramér and Rao on the defocus of a point somewhere in the image, 3000 photons a "
        "channel and 5 a pixel behind it; the other systems in grey. Contrast is averaged over directions and drawn as "
        "its square root: white where all colours are sharp. A mask's phase is that at 530 nm."
    )
    _text(figure, LEFT, 0.16, words, SMALL, color=FAINT)
    return figure


# ---------------------------------------------------------------------- the parts, from left to right


def _head(figure: Figure, height: float, image: Tensor, inverse_depth: Tensor, scene: str) -> None:
    from matplotlib import colormaps  # noqa: PLC0415

    _text(figure, LEFT, height - 0.45, "Published optical systems, side by side", HEADLINE, weight="bold")
    about = (
        "Each as its paper or code describes it, with the masks it starts from before training. What a point of white "
        "light becomes is drawn as the square root of its light, every PSF on a scale of its own; the bar is 10 pixels."
        " The scene's depth is stretched, in dioptres, over the range of each system."
    )
    for line, words in enumerate(textwrap.wrap(about, 150)):
        _text(figure, LEFT, height - 0.72 - 0.17 * line, words, LABEL + 1, color=FAINT)
    y = height - HEAD + 0.34
    headings = (
        (LEFT, "System", "what no text or code says is guessed"),
        (MASK_X, "Mask", "phase, 0 to 2π"),
        (PSF_X, "Point spread functions over depth", "near to far, evenly spaced in dioptres"),
        (CONTRAST_X, "Contrast (MTF)", "of red, green and blue; to ½ cycle a pixel"),
        (BOUND_X, "Depth information", "least error of ψ (√CRLB), rad; lower is better"),
        (CAPTURE_X, "Capture", "with the system's noise"),
    )
    for x, title, subtitle in headings:
        _text(figure, x, y, title, TITLE, weight="bold", color=ACCENT)
        _text(figure, x, y - 0.16, subtitle, SMALL, color=FAINT)
    bar = figure.add_axes((MASK_X / WIDTH, (y - 0.235) / figure.get_figheight(), CELL / WIDTH, 0.03 / height))
    bar.imshow(np.linspace(0, 1, 256)[None], cmap=PHASE_COLORS, aspect="auto")
    bar.set_axis_off()
    side = 1.0
    colors = torch.from_numpy(colormaps[DEPTH_COLORS](inverse_depth[0].cpu().numpy())).permute(2, 0, 1)
    for x, picture, title in (
        (CAPTURE_X - CAPTURE - 0.2, image, f"the scene: {scene}"),
        (CAPTURE_X, colors, "its depth, bright is near"),
    ):
        _picture(figure, (x, height - 0.32 - side, CAPTURE, side), picture)
        _text(figure, x, height - 0.27, title, SMALL, color=FAINT)


def _words(figure: Figure, y: float, portrait: Portrait) -> None:
    system, camera = portrait.system, _metric(portrait.optics)
    lens, aperture = f"{camera.focal_length * 1e3:.3g} mm", f"f/{camera.f_number:.3g}"
    pixels = f"{camera.pixel_pitch * 1e6:.3g} µm pixels"
    _text(figure, LEFT, y + 0.85, system.title, TITLE + 1, weight="bold")
    lines = [
        (f"{system.year}: {textwrap.shorten(system.paper.split(': ')[1], 42, placeholder=' …')}", FAINT),
        (f"{lens} {aperture}, {pixels}, {system.compositing}", INK),
        *((words, ACCENT) for words in textwrap.wrap(system.known_for, 47)[:2]),
    ]
    for line, (words, color) in enumerate(lines):
        _text(figure, LEFT, y + 0.66 - 0.165 * line, words, SMALL + 0.5, color=color)
    if system.guesses:
        words = textwrap.shorten("guessed: " + ", ".join(system.guesses), 62, placeholder=" …")
        _text(figure, LEFT, y - 0.02, words, SMALL - 0.5, color=FAINT, style="italic")


def _mask(figure: Figure, y: float, optics: TiDyOptics) -> None:
    phase = central_square(optics.masks.phase).detach().cpu().remainder(2 * math.pi)
    amplitude = optics.pupil.transmission
    light = torch.nn.functional.avg_pool2d(amplitude[None, None].double(), amplitude.shape[-1] // phase.shape[-1])
    shown = phase.where(light[0] > 0, math.nan)
    step = 0.0 if len(shown) == 1 else 0.3 / (len(shown) - 1)  # several masks are drawn as a stack
    side = CELL - step * (len(shown) - 1)
    for k in range(len(shown) - 1, -1, -1):
        axes = _axes(figure, MASK_X + step * k, y + step * k, side, side, zorder=len(shown) - k)
        axes.imshow(shown[k].numpy(), cmap=PHASE_COLORS, vmin=0, vmax=2 * math.pi, interpolation="nearest")
        axes.set_axis_off()


def _psfs(figure: Figure, y: float, portrait: Portrait) -> None:
    camera, psfs = _metric(portrait.optics), portrait.statistics.psfs
    nodes = torch.linspace(len(psfs) - 1, 0, COLUMNS).round().long().tolist()  # nearest first
    for column, node in enumerate(nodes):
        x = PSF_X + column * (CELL + GAP)
        light = psfs[node].clamp(min=0)
        axes = _picture(figure, (x, y, CELL, CELL), (light / light.amax()).sqrt(), interpolation="nearest")
        psi = float(portrait.statistics.defocus[node])
        depth = depth_at(psi, camera)
        metres = "∞" if math.isinf(depth) or depth > 100 else f"{depth:.2g} m"
        sign = "0" if abs(psi) < 0.5 else f"{psi:+.0f}".replace("-", "−")
        _text(figure, x + CELL / 2, y - 0.12, f"{metres}   ψ = {sign}", SMALL - 0.5, color=FAINT, ha="center")
        if column == 0:
            side = psfs.shape[-1]
            axes.plot([0.06 * side, 0.06 * side + 10], [0.93 * side] * 2, color="white", linewidth=1.5)


def _contrast(figure: Figure, y: float, portrait: Portrait, last: bool) -> None:
    axes = _axes(figure, CONTRAST_X, y, PLOT, CELL)
    picture = portrait.statistics.contrast.flip(0).permute(2, 0, 1).clamp(0, 1).sqrt()  # (F, D, C), near left
    axes.imshow(picture.numpy(), origin="lower", aspect="auto", extent=(0, 1, 0, 0.5), interpolation="bilinear")
    axes.set_yticks([0, 0.25, 0.5], ["0", "", "½"])
    _frame(axes)
    axes.set_xticks([0.0, 0.5, 1.0], ["near", "cycles a pixel over depth", "far"] if last else ["", "", ""])


def _bound(
    figure: Figure, y: float, bounds: Sequence[tuple[Any, Any]], row: int, limits: tuple[float, float], last: bool
) -> None:
    axes = _axes(figure, BOUND_X, y, PLOT, CELL)
    axes.set_facecolor("white")
    for other, (place, bound) in enumerate(bounds):
        if other != row:
            axes.plot(place, bound, color="#d3dae1", linewidth=0.7)
    axes.plot(*bounds[row], color=ACCENT, linewidth=1.8)
    axes.set_yscale("log")
    axes.set_ylim(*limits)
    axes.set_xlim(0, 1)
    ticks = [t for t in (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0) if limits[0] <= t <= limits[1]]
    axes.set_yticks(ticks, [f"{t:g}" for t in ticks])
    axes.minorticks_off()
    axes.grid(axis="y", color="#eceff2", linewidth=0.6)
    _frame(axes)
    axes.set_xticks([0.0, 1.0], ["near", "far"] if last else ["", ""])


# ---------------------------------------------------------------------- pieces


def _metric(optics: TiDyOptics) -> ThinLensCamera:
    if not isinstance(optics.camera, ThinLensCamera):
        raise ValueError(f"a picture of systems needs lenses that know metres, got {type(optics.camera).__name__}")
    return optics.camera


def _place(defocus: Tensor) -> np.ndarray:
    """Return the relative position of defocus in its range, 0 at the near and 1 at the far end."""
    return ((defocus[-1] - defocus) / (defocus[-1] - defocus[0])).numpy()


def _picture(
    figure: Figure, box: tuple[float, float, float, float], image: Tensor, interpolation: str = "antialiased"
) -> Axes:
    axes = _axes(figure, *box)
    axes.imshow(image.detach().cpu().clamp(0, 1).permute(1, 2, 0).numpy(), interpolation=interpolation)
    axes.set_anchor("W")
    axes.set_axis_off()
    return axes


def _axes(figure: Figure, x: float, y: float, width: float, height: float, **style: Any) -> Axes:
    whole = figure.get_figheight()
    return figure.add_axes((x / WIDTH, y / whole, width / WIDTH, height / whole), **style)


def _frame(axes: Axes) -> None:
    axes.tick_params(labelsize=SMALL, length=2, width=0.5, pad=1.5, color=FAINT, labelcolor=FAINT)
    for spine in axes.spines.values():
        spine.set(linewidth=0.5, color=FAINT)


def _text(figure: Figure, x: float, y: float, text: str, size: float, color: str = INK, **style: Any) -> None:
    figure.text(x / WIDTH, y / figure.get_figheight(), text, fontsize=size, color=color, **style)


def _rectangle(figure: Figure, lower: tuple[float, float], upper: tuple[float, float], **style: Any) -> None:
    from matplotlib.patches import Rectangle  # noqa: PLC0415

    (x0, y0), (x1, y1), whole = lower, upper, figure.get_figheight()
    size = ((x1 - x0) / WIDTH, (y1 - y0) / whole)
    figure.add_artist(Rectangle((x0 / WIDTH, y0 / whole), *size, linewidth=0, **style))
