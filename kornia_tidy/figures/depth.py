"""Depth maps in colours linear in inverse depth, with a colour bar in metres."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from kornia_tidy.figures.style import DEPTH_COLORS, FAINT, SMALL, new_figure, quiet
from kornia_tidy.optics.thin_lens import ThinLensCamera

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

UNKNOWN = 0.6  # grey of a pixel without known depth, of white
LONGER_SIDE = 12.0  # inches; 150 dots an inch make 1800 pixels
ROUNDINGS = 4  # of a defocus in float32, within which a depth is taken for infinite
TICK_DEPTHS = (0.1, 0.2, 0.3, 0.4, 0.6, 0.8, 1, 1.5, 2, 2.5, 3, 3.5, 4, 5, 7, 10, 20, 50, math.inf)  # m


def draw_depth(depth: Tensor, camera: ThinLensCamera, deviation: Tensor | None = None) -> Figure:
    """Draw a depth map in colours linear in inverse depth, with a colour bar in metres, grey where it is unknown.

    Args:
        depth: (1, H, W) in metres, may be infinite; depths beyond the camera's range have the colours of its ends.
        camera: its depth range is that of the colour bar.
        deviation: (1, H, W), standard deviation of the normalised inverse depth. Colours fade to grey as its square
            reaches that of an unknown depth, 1/12. None: no pixel is grey.

    Returns:
        A figure; ``figure.savefig(path, dpi=150)`` makes its longer side 1800 pixels, the bar not counted.

    Raises:
        ImportError: if matplotlib is missing.
    """
    height, width = depth.shape[-2:]
    step = max(1, max(height, width) // 1800)
    shown = depth[0, ::step, ::step].detach().cpu()
    far, near = sorted(1 / end for end in camera.depth_range)
    place = ((shown.reciprocal() - far) / (near - far)).clamp(0, 1).numpy()
    scale = LONGER_SIDE / max(height, width)
    across, up, below = max(width * scale, 3.0), height * scale, 0.45  # inches
    figure = new_figure(across, up + below, layout=None)
    axes = figure.add_axes(
        ((1 - width * scale / across) / 2, below / (up + below), width * scale / across, up / (up + below))
    )
    axes.imshow(place, cmap=DEPTH_COLORS, vmin=0, vmax=1, interpolation="antialiased", aspect="auto")
    if deviation is not None:
        unknown = (12 * deviation[0, ::step, ::step].detach().cpu().square()).clamp(max=1).numpy()
        grey = np.full_like(unknown, UNKNOWN)
        axes.imshow(grey, cmap="gray", vmin=0, vmax=1, alpha=unknown, interpolation="antialiased", aspect="auto")
    axes.set_axis_off()
    depth_bar(figure.add_axes((0.06, 0.26 / (up + below), 0.88, 0.1 / (up + below))), camera)
    if deviation is not None:
        figure.text(0.06, 0.38 / (up + below), "grey: unknown", fontsize=SMALL, color=FAINT, va="bottom")
    return figure


def depth_at(defocus: float, camera: ThinLensCamera) -> float:
    """Return the depth in metres for a defocus in radians; infinite for the defocus of infinity and below.

    It is infinite, too, where a few roundings of the defocus in float32 make it so.

    Example:
        >>> round(depth_at(0.0, ThinLensCamera()), 3)
        0.595
    """
    depth = float(camera.depth(torch.tensor(defocus, dtype=torch.float64)))
    rounding = ROUNDINGS * torch.finfo(torch.float32).eps / float(camera.focus_distance)  # of 1 / focus - 1 / depth
    return depth if 1 / depth > rounding else math.inf


def depth_colors(inverse_depth: Tensor) -> Tensor:
    """Return normalised inverse depth (1, H, W) in the colours of depth maps, (3, H, W) in [0, 1]; bright is near."""
    from matplotlib import colormaps  # noqa: PLC0415

    colors = colormaps[DEPTH_COLORS](inverse_depth[0].cpu().clamp(0, 1).numpy())
    return torch.from_numpy(colors[..., :3]).permute(2, 0, 1)


def depth_bar(axes: Axes, camera: ThinLensCamera) -> None:
    """Draw the colour bar of a camera's depth range, far to near, with ticks in metres."""
    axes.imshow(np.linspace(0, 1, 256)[None], cmap=DEPTH_COLORS, aspect="auto", extent=(0, 1, 0, 1))
    ticks = depth_ticks(camera)
    axes.set_xticks([x for x, _ in ticks], [label for _, label in ticks])
    quiet(axes, spines=False)


def depth_ticks(camera: ThinLensCamera) -> list[tuple[float, str]]:
    """Return tick positions on the depth bar (0 far, 1 near) with labels that do not overlap."""
    near, far = camera.depth_range
    span = 1 / near - 1 / far
    ticks: list[tuple[float, str]] = []
    for depth in sorted({*TICK_DEPTHS, near, far}, key=lambda d: (d not in (near, far), -d)):
        place = (1 / depth - 1 / far) / span
        if -1e-9 <= place <= 1 + 1e-9 and all(abs(place - other) > 0.12 for other, _ in ticks):
            ticks.append((place, metres(depth)))
    return [(place, f"{label} m" if place == max(p for p, _ in ticks) else label) for place, label in ticks]


def metres(depth: float) -> str:
    """Format a depth with two significant digits, without its unit.

    Example:
        >>> metres(0.595), metres(math.inf)
        ('0.59', '∞')
    """
    return "∞" if math.isinf(depth) else f"{depth:.2g}"
