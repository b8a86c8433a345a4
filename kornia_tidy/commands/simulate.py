"""`kornia-tidy simulate`: simulation of the coded capture of one picture with depth."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import torch

from kornia_tidy.camera.tidy_optics import COLOR_SPACES
from kornia_tidy.commands.options import (
    add_camera_options,
    add_depth_options,
    add_mask_options,
    add_noise_option,
    add_psfs_option,
    check_output,
    make_optics,
    read_noise,
    read_scene,
    seed,
)
from kornia_tidy.commands.report import (
    Stages,
    clamped_in_words,
    light_in_words,
    masks_in_words,
    scene_in_words,
    tell,
)
from kornia_tidy.data.image_files import write_image
from kornia_tidy.fidelity import PRESETS
from kornia_tidy.optics.holes import HOLES
from kornia_tidy.render.compositing import COMPOSITING
from kornia_tidy.sensor.noise import SensorNoise

DESCRIPTION = """\
Simulate what a camera captures whose K phase masks are shown one after another
during one exposure. The scene is a picture and a depth map of the same size.
"""

EXAMPLES = """\
examples:
  A Kinect frame, depth in millimetres:
    kornia-tidy simulate rgb.png --depth depth.png --depth-scale 0.001 --holes fill \\
        -o coded.png

  A Middlebury stereo scene, with a lens chosen for its depths:
    kornia-tidy simulate im0.png --depth disp0.pfm --depth-kind disparity \\
        --invalid inf --focal-px 999.421 --baseline-m 0.193001 --doffs-px 32.778 \\
        --holes fill --fit-depth

The first one in Python, the same but for the rounding to 8 bits:
  import torch
  from kornia_tidy import PixelwiseMask, TiDyOptics
  from kornia_tidy.data.rgbd import read_rgbd
  image, depth, valid = read_rgbd("rgb.png", "depth.png", scale=0.001)
  optics = TiDyOptics(PixelwiseMask(5, generator=torch.Generator().manual_seed(0)))
  coded = optics(image, depth, generator=torch.Generator().manual_seed(0))
"""


def add_parser(subparsers: Any) -> None:
    """Describe the command to argparse."""
    parser = subparsers.add_parser(
        "simulate",
        help="picture + depth -> coded capture",
        description=DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)
    parser.add_argument("image", metavar="IMAGE", help="picture: PNG, JPEG, TIFF, 8 or 16 bits, or NPY in [0, 1]")
    parser.add_argument("--depth", required=True, metavar="DEPTH", help="its depth: PNG, TIFF, PGM, PFM, NPY, OpenEXR")
    parser.add_argument(
        "-o", "--output", metavar="OUT", help="PNG, TIFF or JPEG to write (default: IMAGE_coded.png, in this folder)"
    )
    parser.add_argument("--bits", type=int, choices=(8, 16), default=8, help="bits a sample of OUT (default: 8)")
    add_depth_options(parser)
    parser.add_argument(
        "--holes",
        choices=HOLES,
        default="error",
        help="pixels of unknown depth: error refuses them, fill takes the depth of the nearest known pixel (default: "
        "error)",
    )
    add_camera_options(parser)

    add_psfs_option(parser)
    add_mask_options(parser.add_argument_group("masks", "Random ones have 23 x 23 pixels: the start of training."))

    capture = parser.add_argument_group("capture")
    capture.add_argument("--seed", type=seed, default=0, metavar="N", help="seed of the sensor's noise (default: 0)")
    add_noise_option(capture, "0.01")
    capture.add_argument(
        "--fidelity", choices=tuple(PRESETS), default="balanced", help="speed or accuracy (default: balanced)"
    )
    capture.add_argument(
        "--compositing",
        choices=tuple(COMPOSITING),
        default="gather",
        help="gather: each pixel collects light through its own depth's PSF, as the paper; scatter: each spreads its "
        "light, which conserves it; occlusion: near things hide far ones, slowest (default: gather)",
    )
    capture.add_argument(
        "--border",
        choices=("reflect", "replicate", "zero", "circular", "valid"),
        default="reflect",
        help="what lies beyond the picture; valid crops it to where all is known (default: reflect)",
    )
    capture.add_argument(
        "--color-space",
        choices=COLOR_SPACES,
        help="srgb: decoded to linear light and encoded after; linear: is light already; paper: sRGB taken for light, "
        "as the paper does (default: srgb; paper with --fidelity paper)",
    )


def run(args: argparse.Namespace) -> None:
    """Simulate the capture and write it."""
    output = args.output or f"{Path(args.image).stem}_coded.png"
    check_output(output, args.image, args.depth, args.psfs, bits=args.bits)
    sensor, _ = read_noise(args.noise)
    stages = Stages()
    with torch.no_grad():
        with stages("read"):
            scene = read_scene(args)
            if args.holes == "error" and (count := int((~scene.valid).sum())):
                raise ValueError(
                    f"{args.depth} has no depth at {count} of its {scene.valid.numel()} pixels: take it from the "
                    f"nearest known ones with --holes fill"
                )
        tell("scene", scene_in_words(scene))

        with stages("PSFs"):
            optics = make_optics(
                args,
                scene,
                sensor=sensor or SensorNoise(),
                fidelity=args.fidelity,
                compositing=args.compositing,
                color_space=args.color_space,
                border=args.border,
            )
            bank = optics.psf_bank(channels=scene.image.shape[0])
        tell("camera", optics.camera.extra_repr())
        tell("masks", masks_in_words(args, optics))
        tell("PSFs", light_in_words(bank, optics))
        tell("capture", f"{optics.compositing}, {optics.border} border, {optics.color_space} colour, {optics.sensor}")

        with stages("capture"):
            coded = optics(scene.image, scene.depth, generator=torch.Generator().manual_seed(args.seed))
    tell("clamped", clamped_in_words(optics, scene.depth))
    with stages("write"):
        write_image(output, coded, bits=args.bits)
    tell("wrote", f"{output}, {coded.shape[-1]} x {coded.shape[-2]} px, {args.bits} bits")
    tell("time", stages.summary())
