"""Overview figure of the library: a scene, its depth, masks, their PSFs over depth, and coded captures."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.figures.depth import depth_at, depth_bar, depth_colors, metres
from kornia_tidy.figures.style import ACCENT, FAINT, INK, LABEL, PHASE_COLORS, SMALL, TITLE, quiet, require_matplotlib
from kornia_tidy.masks.base import central_square
from kornia_tidy.modulator.modulator import DwellTimes
from kornia_tidy.optics.thin_lens import ThinLensCamera
from kornia_tidy.psf.psf_bank import PSFBank

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
    require_matplotlib()
    from matplotlib.figure import Figure  # noqa: PLC0415

    camera = optics.camera
    if not isinstance(camera, ThinLensCamera):
        raise TypeError(f"explain needs a ThinLensCamera, whose depths are metres, got {type(camera).__name__}")
    figure = Figure(figsize=(WIDTH, HEIGHT), facecolor="white", layout="constrained")
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
    _table(parts[1], optics, camera)
    parts[2].suptitle("4  Coded captures", size=TITLE, color=ACCENT)
    _picture(right[0], coded_first, "K = 1: the first mask all the time")
    _picture(right[1], coded_all, f"K = {masks}: all {masks} masks, 1/{masks} of the time each")
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


def _table(part: SubFigure, optics: TiDyOptics, camera: ThinLensCamera) -> None:
    """Draw a row for each mask with its PSFs, and a last one with their average."""
    phase = central_square(optics.masks.phase).detach().cpu().remainder(2 * math.pi)
    shown = min(len(phase), MOST_ROWS)
    with torch.no_grad():
        average = optics.psf_bank()
    nodes = torch.linspace(len(average.defocus) - 1, 0, COLUMNS).round().long().tolist()  # nearest first
    part.suptitle("2  Masks     3  Point spread functions (PSFs) over depth, near to far", size=TITLE, color=ACCENT)
    more = f", {shown} shown" if shown < len(phase) else ""
    words = (
        f"the shutter stays open, so the sensor adds up all {len(phase)} masks{more}; phase: dark 0, light π, dark 2π"
    )
    part.supxlabel(words, size=SMALL, color=FAINT)
    axes = part.subplots(shown + 1, 1 + COLUMNS, squeeze=False)
    for column, node in enumerate(nodes, 1):
        psi = round(float(average.defocus[node]))
        depth = metres(depth_at(float(average.defocus[node]), camera))
        axes[0, column].set_title(f"{depth} m\nψ = {psi:+d}" if psi else f"{depth} m\nψ = 0", size=LABEL, color=INK)
    amplitude = optics.pupil.transmission
    light = torch.nn.functional.avg_pool2d(amplitude[None, None].double(), amplitude.shape[-1] // phase.shape[-1])[0, 0]
    for row, bank in enumerate([*single_mask_banks(optics, shown), average]):
        mask = axes[row, 0]
        if row < shown:
            seen = phase[row].where(light > 0, math.nan).numpy()
            mask.imshow(seen, cmap=PHASE_COLORS, vmin=0, vmax=2 * math.pi, interpolation="nearest")
            mask.set_title(str(row + 1), size=SMALL, color=INK)
        else:
            words = f"average\nof {len(phase)}"
            mask.text(0.5, 0.5, words, size=LABEL, weight="bold", ha="center", va="center", transform=mask.transAxes)
        mask.set_axis_off()
        for column, node in enumerate(nodes, 1):
            psf = bank.psfs[node].detach().cpu()
            _picture(axes[row, column], (psf / psf.max().clamp(min=1e-30)).sqrt())


def _picture(axes: Axes, image: Tensor, title: str = "") -> None:
    pixels = image.detach().cpu().clamp(0, 1).expand(3, -1, -1)
    axes.imshow(pixels.permute(1, 2, 0).numpy(), interpolation="antialiased")
    quiet(axes, spines=False)
    if title:
        axes.set_title(title, size=LABEL, color=FAINT)
