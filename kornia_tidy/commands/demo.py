"""`kornia-tidy demo`: one picture that explains the library, from a scene of its own or of the user's."""

from __future__ import annotations

import argparse
import sys
from io import BytesIO
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from kornia_tidy.commands.options import add_depth_options, middle_depths, read_scene, seed
from kornia_tidy.commands.report import Stages, clamped_in_words, light_in_words, scene_in_words, tell
from kornia_tidy.data.dead_leaves import dead_leaves
from kornia_tidy.data.image_files import write_image
from kornia_tidy.data.rgbd import Scene
from kornia_tidy.figures import explain, require_matplotlib
from kornia_tidy.files import write_bytes
from kornia_tidy.optics.camera import ThinLensCamera
from kornia_tidy.optics.phase_masks import PixelwiseMask
from kornia_tidy.tidy_optics import TiDyOptics

DESCRIPTION = """\
Draw one picture that explains the library: a scene and its depth, five phase masks, the point spread functions that
they make over depth alone and together, and what the camera captures with one mask and with five. Without IMAGE and
DEPTH the scene is made by the library.
"""

NEAR, FAR = 0.3, float("inf")  # m: the default camera's range
DOTS_PER_INCH = 150
CAPTION = (
    "The heights of these masks are random, as before training: they throw light wide, and both captures look alike. "
    "Gradients reach the heights, so that they can be learned. Each PSF is drawn on its own scale, as the square root "
    "of its light."
)


def add_parser(subparsers: Any) -> None:
    """Describe the command to argparse."""
    parser = subparsers.add_parser("demo", help="one picture that explains the library", description=DESCRIPTION)
    parser.set_defaults(run=run)
    parser.add_argument("--image", metavar="IMAGE", help="picture of a scene (default: dead leaves, made here)")
    parser.add_argument("--depth", metavar="DEPTH", help="its depth; focus and aperture are chosen to fit it")
    add_depth_options(parser)
    parser.add_argument(
        "-o", "--output", default="outputs", metavar="FOLDER", help="made if missing (default: outputs)"
    )
    parser.add_argument("--size", type=int, default=512, metavar="PX", help="side of the scene made (default: 512)")
    parser.add_argument("--masks", type=int, default=5, metavar="K", help="masks in one exposure (default: 5)")
    parser.add_argument("--seed", type=seed, default=0, metavar="N", help="seed of scene, masks and noise (default: 0)")


def run(args: argparse.Namespace) -> None:
    """Simulate both captures, draw the picture and write all."""
    if (args.image is None) != (args.depth is None):
        raise ValueError("--image and --depth belong together: give both, or neither for a scene made here")
    if args.masks < 2:
        raise ValueError(f"the demo compares one mask with several: --masks must be 2 or more, got {args.masks}")
    require_matplotlib()
    folder = Path(args.output)
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"cannot write into {folder}: it is not a folder")
    stages = Stages()
    progress = tqdm(
        total=4, desc="demo", bar_format="{desc}: {bar} {n}/{total} {postfix}", file=sys.stderr, leave=False
    )

    with torch.no_grad(), progress:
        progress.set_postfix_str("scene")
        with stages("scene"):
            scene, camera = _scene_and_camera(args)
        captures: list[Tensor] = []
        for k in (1, args.masks):
            progress.update()
            progress.set_postfix_str(f"capture K={k}")
            with stages(f"capture K={k}"):
                masks = PixelwiseMask(k, generator=torch.Generator().manual_seed(args.seed))
                optics = TiDyOptics(masks, camera=camera)
                captures.append(optics(scene.image, scene.depth, generator=torch.Generator().manual_seed(args.seed)))
        progress.update()
        progress.set_postfix_str("picture")
        with stages("picture"):
            picture = BytesIO()
            figure = explain(scene.image, scene.depth, optics, captures[0], captures[1], CAPTION)
            figure.savefig(picture, dpi=DOTS_PER_INCH)
        bank = optics.psf_bank(channels=scene.image.shape[0])

    pictures = {"scene.png": scene.image, "coded_k1.png": captures[0], f"coded_k{args.masks}.png": captures[1]}
    with stages("write"):
        folder.mkdir(parents=True, exist_ok=True)
        for name, image in pictures.items():
            write_image(folder / name, image)
        write_bytes(folder / "demo.png", picture.getvalue())

    tell("scene", scene_in_words(scene))
    tell("camera", camera.extra_repr())
    tell("masks", f"{optics.masks.extra_repr()}, noise of seed {args.seed}; K = 1 is the first of them")
    tell("PSFs", light_in_words(bank, optics))
    tell("clamped", clamped_in_words(optics, scene.depth))
    tell("wrote", f"{folder / 'demo.png'}: look at this one")
    for name in pictures:
        tell("", str(folder / name))
    tell("time", stages.summary())


def _scene_and_camera(args: argparse.Namespace) -> tuple[Scene, ThinLensCamera]:
    if args.image is None:
        image, depth = dead_leaves(args.size, args.size, depth_range=(NEAR, FAR), seed=args.seed)
        return Scene(image, depth, torch.ones_like(depth, dtype=torch.bool)), ThinLensCamera()
    scene = read_scene(args)
    return scene, ThinLensCamera.for_scene(middle_depths(scene.depth, scene.valid))
