"""Draw the animation at the top of the documentation, docs/images/exposure.webp, with the library itself.

    python docs/make_animation.py

One exposure through the five masks of the trained system "edof-designed": each mask in turn, its PSF from near to far,
the average of the PSFs so far, and the light that the sensor has collected. At the end the restoration of the network.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np
import torch
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image
from torch import Tensor

from kornia_tidy import TiDyOptics
from kornia_tidy.data import sample_scene
from kornia_tidy.modulator import DwellTimes
from kornia_tidy.reconstruction.pretrained import load_pretrained

PICTURE = Path(__file__).resolve().parent / "images" / "exposure.webp"
WIDTH, HEIGHT, DOTS = 6.62, 3.0, 100  # inches, dots an inch
DEPTHS = 7  # of a point, from near to far, for each mask
FRAME, LAST = 120, 2500  # ms
QUALITY = 70  # of the file, of 100
PSF = 24  # pixels of a PSF on each side of its middle
INK, FAINT = "#1c2733", "#5b6671"


@torch.no_grad()
def main(arguments: Sequence[str] | None = None) -> Path:
    """Draw the animation and return where it was written."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--size", type=int, default=300, help="height of the scene in pixels (default: 300)")
    parser.add_argument("--output", type=Path, default=PICTURE, help="picture to write (default: %(default)s)")
    options = parser.parse_args(arguments)

    system = load_pretrained("edof-designed")
    scene, optics = sample_scene(height=options.size), system.optics
    count = len(optics.masks.heights())
    banks = [optics.through_state(k).psf_bank() for k in range(count)]
    nodes = torch.linspace(len(banks[0].defocus) - 1, 0, DEPTHS).round().long().tolist()  # nearest first
    metres = optics.camera.depth(banks[0].defocus[nodes]).tolist()
    phases = optics.masks.phase.remainder(2 * math.pi) / (2 * math.pi)

    frames = []
    for shown in range(count):
        dwell = [float(mask <= shown) for mask in range(count)]
        exposed = TiDyOptics(
            optics.masks, optics.camera, DwellTimes(dwell), None, optics.fidelity.replace(window=optics.window)
        )
        light = rgb_to_linear_rgb(exposed(scene.image, scene.depth).clamp(0, 1)[None]) * (shown + 1) / count
        collected = linear_rgb_to_rgb(light)[0].clamp(0, 1)
        for node, depth in zip(nodes, metres, strict=True):
            average = torch.stack([bank.psfs[node] for bank in banks[: shown + 1]]).mean(0)
            words = f"mask {shown + 1} of {count}", _words(depth), f"average of {shown + 1}", "light collected so far"
            pictures = phases[shown], banks[shown].psfs[node], average, collected
            frames.append(_frame(pictures, words))
    generator = torch.Generator().manual_seed(0)
    restored = system.head(optics(scene.image, scene.depth, generator=generator)[None])[0].clamp(0, 1)
    words = f"mask {count} of {count}", _words(metres[-1]), f"average of {count}", "restored by the network"
    frames.append(_frame((phases[-1], banks[-1].psfs[nodes[-1]], average, restored), words))

    options.output.parent.mkdir(parents=True, exist_ok=True)
    times = [FRAME] * (len(frames) - 1) + [LAST]
    frames[0].save(options.output, save_all=True, append_images=frames[1:], duration=times, loop=0, quality=QUALITY)
    return options.output


def _words(depth: float) -> str:
    return f"its PSF at {depth:.2f} m" if depth < 1e3 else "its PSF at \N{INFINITY}"


def _frame(pictures: tuple[Tensor, ...], words: tuple[str, ...]) -> Image.Image:
    """Draw a frame: mask, its PSF, the average PSF, and the light on the sensor."""
    phase, psf, average, light = pictures
    figure = Figure(figsize=(WIDTH, HEIGHT), facecolor="white")
    mask = torch.from_numpy(mpl.colormaps["twilight"](np.asarray(phase))[..., :3]).permute(2, 0, 1)
    middle = psf.shape[-1] // 2
    inner = slice(max(0, middle - PSF), middle + PSF + 1)
    cropped = (one[:, inner, inner] for one in (psf, average))
    shown = mask, *((one / one.amax()).sqrt() for one in cropped), light  # the root makes faint light visible
    places = (0.15, 1.55, 1.2), (1.55, 1.55, 1.2), (1.55, 0.1, 1.2), (2.95, 0.1, None)
    for picture, (x, y, side), text in zip(shown, places, words, strict=True):
        wide, high = (side, side) if side else (picture.shape[-1] / picture.shape[-2] * 2.65, 2.65)
        axes = figure.add_axes((x / WIDTH, y / HEIGHT, wide / WIDTH, high / HEIGHT))
        axes.set_axis_off()
        axes.imshow(picture.clamp(0, 1).permute(1, 2, 0).numpy())
        figure.text(x / WIDTH, (y + high + 0.06) / HEIGHT, text, fontsize=8.5, color=INK)
    figure.text(0.15 / WIDTH, 0.7 / HEIGHT, "one exposure,\nfive phase masks", fontsize=9, color=FAINT, va="center")
    canvas = FigureCanvasAgg(figure)
    figure.set_dpi(DOTS)
    canvas.draw()
    return Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())


if __name__ == "__main__":
    main()
