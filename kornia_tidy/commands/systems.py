"""`kornia-tidy systems`: nine published optical systems, listed and drawn side by side."""

from __future__ import annotations

import argparse
import sys
from io import BytesIO
from pathlib import Path
from typing import Any

import torch
from kornia.geometry.transform import resize
from torch import Tensor
from tqdm import tqdm

from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.commands.options import add_depth_options, check_output, middle_depths, read_scene, seed
from kornia_tidy.commands.report import Stages, tell
from kornia_tidy.data.dead_leaves import dead_leaves
from kornia_tidy.figures.style import require_matplotlib
from kornia_tidy.figures.system_statistics import system_statistics
from kornia_tidy.figures.systems import Portrait, draw_systems
from kornia_tidy.files import write_bytes
from kornia_tidy.inference.tasks import metres
from kornia_tidy.systems.presets import SYSTEMS, published_system
from kornia_tidy.systems.system import System

DESCRIPTION = """\
List nine published optical systems and draw them side by side in one picture: their
masks, point spread functions (PSF) and contrast (MTF) over depth, the Cramér-Rao bound
on the depth of a point, and the capture of one scene.
"""

EPILOG = """\
Masks are those that a system starts from before training. The same systems in Python:
  from kornia_tidy import TiDyOptics
  optics = TiDyOptics.from_preset("phasecam3d")
  coded = optics(image, depth)
Where each value was read stands in kornia_tidy.systems.SYSTEMS["phasecam3d"].sources;
values that no text or code would give are guesses, and are listed as such.

examples:
  kornia-tidy systems                                    all nine, on a scene made here
  kornia-tidy systems --systems tidy-5,ikoma2021 -o two.png
  kornia-tidy systems --image rgb.png --depth depth.png --depth-scale 0.001
"""

DOTS_PER_INCH = 120
HEADINGS = ("name", "lens", "mask", "depth, m", "psi, rad", "noise", "guessed", "source")


def add_parser(subparsers: Any) -> None:
    """Describe the command to argparse."""
    parser = subparsers.add_parser(
        "systems",
        help="nine published systems side by side",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)
    parser.add_argument(
        "--systems", metavar="A,B", help=f"some of {', '.join(SYSTEMS)}, in the order given (default: all)"
    )
    parser.add_argument(
        "-o", "--output", default="systems.png", metavar="OUT", help="picture to write (default: systems.png)"
    )
    parser.add_argument("--image", metavar="IMAGE", help="picture of a scene (default: dead leaves, made here)")
    parser.add_argument(
        "--depth",
        metavar="DEPTH",
        help="its depth. It is stretched, in dioptres, over each system's own range, so that all use all of it",
    )
    parser.add_argument(
        "--size",
        type=int,
        default=320,
        metavar="PX",
        help="longer side of the scene: larger ones are made smaller, and blur then looks larger (default: 320)",
    )
    parser.add_argument("--seed", type=seed, default=0, metavar="N", help="seed of scene, masks and noise (default: 0)")
    add_depth_options(parser)


def run(args: argparse.Namespace) -> None:
    """List the systems, compute their statistics, and draw them."""
    systems = _chosen(args)
    check_output(args.output, args.image, args.depth)
    require_matplotlib()
    stages, portraits = Stages(), []
    progress = tqdm(systems, desc="systems", file=sys.stderr, leave=False, unit="system", disable=None)
    with torch.no_grad(), progress:
        with stages("scene"):
            image, inverse_depth, scene = _scene(args)
        for system in progress:
            progress.set_postfix_str(system.name)
            with stages("cameras"):
                camera = system.camera()
                masks = torch.Generator().manual_seed(args.seed)
                optics = TiDyOptics.from_preset(system.name, generator=masks, camera=camera)
            with stages("statistics"):
                seen = system_statistics(optics.psf_model)
            with stages("captures"):
                generator = torch.Generator().manual_seed(args.seed)
                capture = optics(image, metres(camera, inverse_depth), generator=generator)
            portraits.append(Portrait(system, optics, seen, capture))
        with stages("picture"):
            picture = BytesIO()
            suffix = Path(args.output).suffix[1:]
            draw_systems(portraits, image, inverse_depth, scene).savefig(picture, dpi=DOTS_PER_INCH, format=suffix)
    print("\n".join(table([portrait.system for portrait in portraits])))
    print()
    write_bytes(args.output, picture.getvalue())
    tell("wrote", f"{args.output}: look at it")
    tell("time", stages.summary())


def table(systems: list[System]) -> list[str]:
    """Return the systems as lines of aligned columns, the headings first.

    Example:
        >>> print(table([published_system("ikoma2021")])[1][:68])
        ikoma2021  50 mm f/6.3, focus 1.7 m  radial profile, 61 radii, noise
    """
    rows = [HEADINGS]
    for system in systems:
        camera = system.camera()
        (near, far), (lo, hi) = camera.depth_range, camera.defocus_range
        rows.append(
            (
                system.name,
                f"{camera.focal_length * 1e3:.3g} mm f/{camera.f_number:.3g}, focus {camera.focus_distance:.3g} m",
                system.mask,
                f"{near:.3g} to {far:g}",
                f"{hi:+.1f} to {lo:+.1f}",
                f"{system.sigma:g}",
                str(len(system.guesses)),
                system.paper,
            )
        )
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def _chosen(args: argparse.Namespace) -> list[System]:
    """Check the arguments before any work, and return the chosen systems."""
    if (args.image is None) != (args.depth is None):
        raise ValueError("--image and --depth belong together: give both, or neither for a scene made here")
    if args.size < 32:
        raise ValueError(f"--size must be 32 pixels or more, got {args.size}")
    names = list(SYSTEMS) if args.systems is None else [name.strip() for name in args.systems.split(",")]
    return [published_system(name) for name in names]


def _scene(args: argparse.Namespace) -> tuple[Tensor, Tensor, str]:
    """Return an RGB image, its normalised inverse depth in [0, 1], and its name."""
    if args.image is None:
        height, width = round(args.size * 0.625), args.size
        image, depth = dead_leaves(height, width, depth_range=(0.5, 5.0), seed=args.seed)
        valid, name = torch.ones_like(depth, dtype=torch.bool), "dead leaves"
    else:
        image, depth, valid = read_scene(args)
        name = Path(args.image).name
    near, far = (1 / end for end in middle_depths(depth, valid))
    inverse_depth = ((1 / depth - far) / (near - far)).clamp(0, 1)
    image = image.expand(3, -1, -1)
    if max(image.shape[-2:]) > args.size:
        image = resize(image[None], args.size, side="long", antialias=True)[0].clamp(0, 1)
        inverse_depth = resize(inverse_depth[None], args.size, side="long", interpolation="nearest")[0]
    return image, inverse_depth, name
