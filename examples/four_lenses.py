"""What does a real lens do to a picture? One scene behind four lenses, in the middle and in the corner of their field.

    python examples/four_lenses.py --size 192

The lenses come from published prescriptions and have no mask in their stop. Printed is how far the corner's capture is
from that of an ideal lens (RMS, full scale 1, without noise), its light relative to the middle, and how much the PSF in
focus differs from that of the axis (relative L2). With the defaults the corner of the double Gauss and of the triplet
is 0.01 from an ideal lens, that of the single element 0.05, and that of the small wide lens on pixels of 1.4 um 0.2,
where half of the light is left. Distortion is not in: see `kornia_tidy.camera.distorted`.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import torch
from matplotlib.figure import Figure
from torch import Tensor

from kornia_tidy import NoMask, TiDyOptics
from kornia_tidy.data import dead_leaves
from kornia_tidy.optics import Lens

FOCUS = 0.595  # metres
LENSES = {  # f-number and pixel pitch in metres
    "double-gauss-50mm": (17.6, 8e-6),
    "triplet-50mm": (17.6, 8e-6),
    "single-50mm": (17.6, 8e-6),
    "phone-5.5mm": (5.6, 1.4e-6),
}


class Seen(NamedTuple):
    """Captures of one lens, linear light."""

    ideal: Tensor
    middle: Tensor
    corner: Tensor
    error: float
    """Root mean square between the corner and the ideal lens."""
    light: float
    """In the corner, relative to the middle."""
    psf: float
    """Relative L2 distance of the corner's PSF in focus from that of the axis."""


@torch.no_grad()
def main(arguments: Sequence[str] | None = None) -> dict[str, Seen]:
    """Take the pictures and return them by the names of the lenses."""
    options = parse(arguments)
    image, depth = dead_leaves(options.size, options.size, depth_range=(0.5, 0.75), num_leaves=200, seed=4)
    result = {}
    for name, (f_number, pitch) in LENSES.items():
        seen = result[name] = behind(Lens.named(name, f_number, FOCUS), pitch, image**2.2, depth, options.fidelity)
        words = f"{seen.error:.3f} from an ideal lens, {seen.light:.0%} of the light, PSF {seen.psf:.0%} off the axis'"
        print(f"{name:>18} f/{f_number:g}: corner {words}")
    options.output.mkdir(parents=True, exist_ok=True)
    draw(options.output / "four_lenses.png", result)
    print(f"wrote {options.output / 'four_lenses.png'}")
    return result


def behind(lens: Lens, pitch: float, light: Tensor, depth: Tensor, fidelity: str) -> Seen:
    """Return what a lens makes of a scene in the middle and in the corner of its field, beside an ideal lens."""
    camera, settings = lens.camera(pitch), {"sensor": None, "color_space": "linear", "fidelity": fidelity}
    ideal = TiDyOptics(NoMask(), camera, **settings)(light, depth)
    real = TiDyOptics(NoMask(23), camera, lens=lens, **settings)
    along = (lens.field / pitch - math.hypot(*light.shape[-2:]) / 2) / math.sqrt(2)
    middle, corner = (real(light, depth, field_center=(place, place)) for place in (0.0, math.floor(along)))
    bank = real.psf_bank(defocus=[0.0], field=[(0.0, 0.0), (along, along)])
    axis, there = bank.psfs[:, 0, 1]
    error = float((corner - ideal).square().mean().sqrt())
    return Seen(ideal, middle, corner, error, float(bank.light[1, 0, 1]), float((there - axis).norm() / axis.norm()))


def draw(path: Path, result: dict[str, Seen]) -> None:
    """Draw a row for each lens: the ideal lens, the middle and the corner, and five times what the corner differs."""
    figure = Figure(figsize=(9, 2.4 * len(result)), layout="constrained")
    for axes, (name, seen) in zip(figure.subplots(len(result), 4), result.items(), strict=True):
        pictures = {
            "ideal lens": seen.ideal,
            "middle": seen.middle,
            "corner": seen.corner,
            "5 x (corner - ideal)": 0.2 + 5 * (seen.corner - seen.ideal),
        }
        for one, (title, picture) in zip(axes, pictures.items(), strict=True):
            one.imshow((picture.clamp(0, 1).movedim(0, -1) ** (1 / 2.2)).numpy())
            one.set(xticks=[], yticks=[], title=title)
        axes[0].set_ylabel(name)
    figure.savefig(path, dpi=110)


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", type=int, default=192, help="side of the scene in pixels (default: 192)")
    parser.add_argument("--fidelity", default="balanced", help="speed or accuracy (default: balanced)")
    parser.add_argument("--output", type=Path, default=Path("outputs/four_lenses"), help="folder to write to")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
