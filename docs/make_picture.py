"""Draw the picture at the top of the README, docs/images/camera.png, with the library itself on a sample scene.

    python docs/make_picture.py

Scene, captures and estimates are those of the trained system "joint-uncertain" that comes with the library: five
learnt masks and the network that reads their capture.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import FancyArrowPatch, Rectangle
from PIL import Image
from torch import Tensor

from kornia_tidy.data import sample_scene
from kornia_tidy.psf import PSFBank
from kornia_tidy.reconstruction.pretrained import load_pretrained
from kornia_tidy.reconstruction.tasks import split_maps
from kornia_tidy.reconstruction.trained import TrainedSystem

PICTURE = Path(__file__).resolve().parent / "images" / "camera.png"
WIDTH, HEIGHT, DOTS = 12.0, 5.3, 110  # inches, dots an inch: 1320 x 583 pixels
INK, FAINT, ACCENT = "#1c2733", "#5b6671", "#c2410c"
SIDE, CELL, STEP = 2.05, 0.54, 0.6  # inches: a picture, a PSF, and from one PSF to the next
UPPER, LOWER = 2.72, 0.2  # lower edges of the two rows of pictures
SCENE_X, MASKS_X, PSFS_X, CAPTURE_X, ESTIMATE_X = 0.2, 2.85, 3.6, 7.3, 9.75
TOP = 4.17  # upper edge of the first row of PSFs
COLUMNS = 5


@torch.no_grad()
def main(arguments: Sequence[str] | None = None) -> Path:
    """Draw the picture and return where it was written."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--size", type=int, default=256, help="side of the scene in pixels (default: 256)")
    parser.add_argument("--seed", type=int, default=12, help="of the noise (default: 12)")
    parser.add_argument("--output", type=Path, default=PICTURE, help="picture to write (default: %(default)s)")
    options = parser.parse_args(arguments)

    system = load_pretrained("joint-uncertain")
    camera = system.optics.camera
    scene = sample_scene(height=options.size)
    margin = (scene.image.shape[-1] - options.size) // 2
    image, depth = (part[..., margin : margin + options.size] for part in (scene.image, scene.depth))
    capture = system.optics(image, depth, generator=torch.Generator().manual_seed(options.seed))
    estimate = {name: found[0] for name, found in split_maps("joint", system.head(capture[None])).items()}
    lo, hi = camera.defocus_range
    truth = ((camera.defocus(depth) - lo) / (hi - lo)).clamp(0, 1)

    figure = Figure(figsize=(WIDTH, HEIGHT), facecolor="white")
    _picture(figure, SCENE_X, UPPER, image, "A scene")
    _picture(figure, SCENE_X, LOWER, _depth_colors(truth), "and its depth", "near is bright")
    _psfs(figure, system)
    _picture(figure, CAPTURE_X, (UPPER + LOWER) / 2, capture, "The coded capture", "one exposure, five masks")
    _picture(figure, ESTIMATE_X, UPPER, estimate["image"], "Restored by the network", "sharp at all depths")
    _picture(figure, ESTIMATE_X, LOWER, _depth_colors(estimate["depth"]), "and its depth")
    middle = (UPPER + LOWER + SIDE) / 2
    _arrow(figure, (SCENE_X + SIDE + 0.07, middle), (MASKS_X - 0.15, middle))
    _arrow(figure, (CAPTURE_X + SIDE + 0.07, middle), (ESTIMATE_X - 0.07, middle))
    options.output.parent.mkdir(parents=True, exist_ok=True)
    _save(figure, options.output)
    return options.output


def _psfs(figure: Figure, system: TrainedSystem) -> None:
    """Draw the masks, the PSFs of each over depth, and the average of all of them, which the sensor adds up."""
    optics = system.optics
    average = optics.psf_bank()
    columns = torch.linspace(len(average.defocus) - 1, 0, COLUMNS).round().long().tolist()  # nearest first
    count = len(optics.masks.heights())
    _text(figure, MASKS_X, TOP + 0.8, f"{count} phase masks, shown in turn, and", 11, weight="bold")
    _text(figure, MASKS_X, TOP + 0.58, "the blur of each over depth (PSFs)", 11, weight="bold")
    for column, metres in enumerate(optics.camera.depth(average.defocus[columns]).tolist()):
        label = f"{metres:.2f} m" if metres < 1e3 else "\N{INFINITY}"
        _text(figure, PSFS_X + column * STEP + CELL / 2, TOP + 0.12, label, 9.5, FAINT, ha="center")
    for row, bank in enumerate(optics.through_state(k).psf_bank() for k in range(count)):
        y = TOP - CELL - row * STEP
        _mask(figure, MASKS_X, y, optics.masks.phase[row], optics.pupil.amplitude)
        _row_of_psfs(figure, y, bank, columns)
    y = LOWER + 0.02
    _row_of_psfs(figure, y, average, columns)
    right = PSFS_X + (COLUMNS - 1) * STEP + CELL
    figure.add_artist(_box((PSFS_X - 0.07, y - 0.07), (right + 0.07, y + CELL + 0.07)))
    for column in range(COLUMNS):
        x = PSFS_X + column * STEP + CELL / 2
        _arrow(figure, (x, TOP - count * STEP + 0.02), (x, y + CELL + 0.09))
    _text(figure, MASKS_X + CELL / 2, y + CELL / 2, "their\naverage", 9.5, ha="center", va="center", weight="bold")
    elbow = "angle,angleA=0,angleB=90"
    _arrow(figure, (right + 0.12, y + CELL / 2), (CAPTURE_X + SIDE / 2, (UPPER + LOWER) / 2 - 0.07), elbow)
    _text(figure, CAPTURE_X - 0.3, y + CELL / 2 + 0.1, "blurs the scene", 9.5, FAINT)


def _row_of_psfs(figure: Figure, y: float, bank: PSFBank, columns: Sequence[int]) -> None:
    for column, node in enumerate(columns):
        light = bank.psfs[node] / bank.psfs[node].amax()
        _show(figure, (PSFS_X + column * STEP, y), CELL, light.sqrt())  # the root makes faint light visible


def _mask(figure: Figure, x: float, y: float, phase: Tensor, amplitude: Tensor) -> None:
    cells = amplitude.shape[-1] // phase.shape[-1]
    light = torch.nn.functional.avg_pool2d(amplitude[None, None].double(), cells)[0, 0]
    colors = mpl.colormaps["twilight"](np.asarray(phase.remainder(2 * math.pi) / (2 * math.pi)))[..., :3]
    colors[(light == 0).numpy()] = 1
    _show(figure, (x, y), CELL, torch.from_numpy(colors).permute(2, 0, 1), "nearest")


def _depth_colors(near: Tensor) -> Tensor:
    return torch.from_numpy(mpl.colormaps["inferno"](near[0].clamp(0, 1).numpy())[..., :3]).permute(2, 0, 1)


def _picture(figure: Figure, x: float, y: float, image: Tensor, title: str, subtitle: str = "") -> None:
    _show(figure, (x, y), SIDE, image)
    _text(figure, x, y + SIDE + (0.26 if subtitle else 0.08), title, 11, weight="bold")
    _text(figure, x, y + SIDE + 0.08, subtitle, 9.5, FAINT)


def _show(
    figure: Figure, corner: tuple[float, float], side: float, image: Tensor, interpolation: str = "antialiased"
) -> Axes:
    axes = figure.add_axes((corner[0] / WIDTH, corner[1] / HEIGHT, side / WIDTH, side / HEIGHT))
    axes.imshow(image.clamp(0, 1).permute(1, 2, 0).numpy(), interpolation=interpolation)
    axes.set_axis_off()
    return axes


def _text(figure: Figure, x: float, y: float, words: str, size: float, color: str = INK, **style: str) -> None:
    figure.text(x / WIDTH, y / HEIGHT, words, fontsize=size, color=color, **style)


def _arrow(figure: Figure, start: tuple[float, float], end: tuple[float, float], path: str = "arc3") -> None:
    ends = [(x / WIDTH, y / HEIGHT) for x, y in (start, end)]
    style = {"arrowstyle": "-|>", "mutation_scale": 11, "linewidth": 1.4, "color": ACCENT, "shrinkA": 0, "shrinkB": 0}
    figure.add_artist(FancyArrowPatch(*ends, connectionstyle=path, **style))


def _box(lower: tuple[float, float], upper: tuple[float, float]) -> Rectangle:
    (x0, y0), (x1, y1) = lower, upper
    size = ((x1 - x0) / WIDTH, (y1 - y0) / HEIGHT)
    return Rectangle((x0 / WIDTH, y0 / HEIGHT), *size, fill=False, linewidth=1.4, edgecolor=ACCENT)


def _save(figure: Figure, path: Path) -> None:
    """Write the figure in 256 colours, half of the bytes."""
    canvas = FigureCanvasAgg(figure)
    figure.set_dpi(DOTS)
    canvas.draw()
    pixels = np.asarray(canvas.buffer_rgba())[..., :3]
    picture = Image.fromarray(pixels)
    picture.quantize(palette=picture.quantize(256)).save(path, optimize=True)  # with a palette, Pillow dithers


if __name__ == "__main__":
    main()
