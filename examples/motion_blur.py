"""Which way did it move? A mask that changes during the exposure writes the direction of motion into the blur.

    python examples/motion_blur.py --masks 5 --pixels 16

A scene moves to the right while the shutter is open, then the same to the left. Through a mask that stands still the
two pictures are one: a sum does not know its order. Where the mask changes meanwhile, each place on the way is seen
through another PSF, and the pictures differ. Printed is by how much (RMS, full scale 1, without noise), and how far the
picture is from what one gets by blurring the picture at rest along the way, which a changing mask does not do either.

With the defaults the two directions are 0.014 apart with five masks learnt to focus a point at all depths, 0.0028 with
five random ones, which blur so far that little else is seen, and 3e-8 with one mask, which is rounding.

What motion costs a restoration that assumes a scene at rest is experiment 10 of `examples/paper/`.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import torch
from learn_point_psf import learn
from matplotlib.figure import Figure
from torch import Tensor

from kornia_tidy import PixelwiseMask, TiDyOptics, moving_capture
from kornia_tidy.camera.motion import moment_times, scenes_by_homography
from kornia_tidy.data.dead_leaves import dead_leaves


@torch.no_grad()
def main(arguments: Sequence[str] | None = None) -> dict[str, tuple[float, float]]:
    """Take the pictures; return for each camera how far the directions, and motion and blur, are apart."""
    options = parse(arguments)
    torch.manual_seed(0)
    with torch.enable_grad():
        learnt = learn(options.masks, 0, options.iterations, 2e-8)[0].masks
    random = PixelwiseMask(options.masks)
    cameras = {
        "one mask, standing still": PixelwiseMask(initial=random.heights()[:1].repeat(options.masks, 1, 1)),
        f"{options.masks} random masks": random,
        f"{options.masks} learnt masks": learnt,
    }
    image, depth = (x[None] for x in dead_leaves(options.size, options.size, seed=1))
    result, rows = {}, []
    for name, masks in cameras.items():
        optics = TiDyOptics(masks, sensor=None, color_space="linear", border="replicate")
        way = options.pixels * (moment_times(optics) - 0.5)
        right, left = (moving_capture(optics, *moved(image, depth, sign * way)) for sign in (1, -1))
        still = optics(image, depth)
        blurred = sum(moved(still, depth, way)[0].unbind(1)) / len(way)
        margin = options.pixels + optics.window // 2
        result[name] = (rms(right - left, margin), rms(right - blurred, margin))
        print(f"{name:>24}: right and left {result[name][0]:.1e} apart, motion and blur {result[name][1]:.1e} apart")
        rows.append((name, (still, right, left, 0.5 + 5 * (right - left))))
    options.output.mkdir(parents=True, exist_ok=True)
    picture = options.output / "motion_blur.png"
    draw(picture, rows)
    print(f"wrote {picture}")
    return result


def moved(image: Tensor, depth: Tensor, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """Return the scene moved to the right by so many pixels at each moment."""
    moves = torch.eye(3).repeat(len(pixels), 1, 1)
    moves[:, 0, 2] = pixels
    return scenes_by_homography(image, depth, moves)


def rms(difference: Tensor, margin: int) -> float:
    """Return the root mean square away from the border, where the scene comes into view."""
    return float(difference[..., margin:-margin, margin:-margin].square().mean().sqrt())


def draw(path: Path, rows: Sequence[tuple[str, tuple[Tensor, ...]]]) -> None:
    """Draw for each camera the picture at rest, moving right, moving left, and five times their difference."""
    figure = Figure(figsize=(9, 2.4 * len(rows)), layout="constrained")
    for axes, (name, pictures) in zip(figure.subplots(len(rows), 4), rows, strict=True):
        titles = ("at rest", "moving right", "moving left", "5 x (right - left)")
        for one, picture, title in zip(axes, pictures, titles, strict=True):
            one.imshow((picture[0].clamp(0, 1).movedim(0, -1) ** (1 / 2.2)).numpy())
            one.set(xticks=[], yticks=[], title=title)
        axes[0].set_ylabel(name)
    figure.savefig(path, dpi=110)


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--masks", type=int, default=5, help="number K of masks (default: 5)")
    parser.add_argument("--pixels", type=int, default=16, help="way in one exposure (default: 16)")
    parser.add_argument("--size", type=int, default=256, help="side of the scene in pixels (default: 256)")
    parser.add_argument("--iterations", type=int, default=100, help="steps in which masks are learnt (default: 100)")
    parser.add_argument("--output", type=Path, default=Path("outputs/motion_blur"), help="folder to write to")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
