"""`kornia-tidy raw simulate`: simulation of a camera's raw file of a scene with depth."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kornia_tidy.commands.options import (
    add_camera_options,
    add_depth_options,
    make_camera,
    mask_count,
    read_scene,
    seed,
)
from kornia_tidy.commands.raw_options import check_outputs
from kornia_tidy.commands.report import Stages, clamped_in_words, light_in_words, scene_in_words, tell
from kornia_tidy.fidelity import PRESETS
from kornia_tidy.raw.simulation import simulate_scene
from kornia_tidy.render.compositing import COMPOSITING

if TYPE_CHECKING:
    from kornia_tidy.raw.capture import RawCapture
    from kornia_tidy.sensor.noise import SensorNoise

DESCRIPTION = """\
Simulate the raw file of a camera with coded optics. The scene is a picture with a depth
map of the same size. It is blurred by the lens with its K phase masks, sampled through
the filter array, and recorded with the camera's noise, black and white level. The
result is an uncompressed DNG, which any raw software opens.
"""

EXAMPLES = """\
examples:
  For one's own camera: filter array, levels and colours of one of its files, and its
  noise from 'kornia-tidy raw calibrate-noise':
    kornia-tidy raw simulate --image rgb.png --depth depth.png --depth-scale 0.001 \\
        --like shot.cr2 --noise iso800.json -o coded.dng

  A 14-bit sensor that is given in words:
    kornia-tidy raw simulate --image rgb.png --depth depth.pfm --pattern GBRG \\
        --bits 14 --full-well 30000 --read-noise 3 -o coded.dng

In Python: simulate_scene(image, depth, TiDyOptics(sensor=None), camera, noise)
"""

FULL_WELL, READ_NOISE = 10500.0, 2.4  # electrons: a small industrial sensor of 3.45 um pixels
PATTERN, BITS = "RGGB", 12


def add_parser(subparsers: Any) -> None:
    """Describe the subcommand to argparse."""
    parser = subparsers.add_parser(
        "simulate",
        help="picture + depth -> raw file",
        description=DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)
    parser.add_argument("--image", required=True, metavar="IMAGE", help="picture: PNG, JPEG, TIFF or NPY")
    parser.add_argument("--depth", required=True, metavar="DEPTH", help="its depth: PNG, TIFF, PGM, PFM, NPY, OpenEXR")
    parser.add_argument("-o", "--output", required=True, metavar="OUT.dng", help="DNG to write")

    sensor = parser.add_argument_group("sensor", "That of a raw file, or one given in words.")
    sensor.add_argument("--like", metavar="FILE", help="raw file whose filter array, levels and colours are taken")
    sensor.add_argument("--pattern", type=str.upper, help=f"filter array's tile, by rows (default: {PATTERN})")
    sensor.add_argument(
        "--bits",
        type=int,
        choices=(10, 12, 14, 16),
        help=f"of the converter, whose white is 2^bits - 1 (default: {BITS})",
    )
    sensor.add_argument("--black", type=int, metavar="N", help="count without light (default: 2^bits / 16)")
    sensor.add_argument("--white", type=float, metavar="N", help="saturation count, replaces that of FILE")
    sensor.add_argument(
        "--color",
        choices=("camera", "channels"),
        help="camera: the picture's colours are seen through the camera's filters, by its matrix and white balance; "
        "channels: red, green and blue are the camera's own (default: camera with --like, else channels)",
    )
    sensor.add_argument("--noise", metavar="NOISE.json", help="what 'kornia-tidy raw calibrate-noise' wrote")
    sensor.add_argument(
        "--full-well", type=float, metavar="E", help=f"electrons that make white (default: {FULL_WELL:g})"
    )
    sensor.add_argument("--read-noise", type=float, metavar="E", help=f"electrons (default: {READ_NOISE:g})")
    sensor.add_argument("--seed", type=seed, default=0, metavar="N", help="seed of the noise (default: 0)")

    add_depth_options(parser)
    add_camera_options(parser)
    masks = parser.add_argument_group("masks", "23 x 23 pixels of random height, the start of training.")
    masks.add_argument("--masks", type=mask_count, default=5, metavar="K", help="shown in one exposure (default: 5)")
    masks.add_argument("--mask-seed", type=seed, default=0, metavar="N", help="seed of their heights (default: 0)")
    masks.add_argument("--fidelity", choices=tuple(PRESETS), default="balanced", help="(default: balanced)")
    masks.add_argument("--compositing", choices=tuple(COMPOSITING), default="gather", help="(default: gather)")


def run(args: argparse.Namespace) -> None:
    """Simulate the capture and write it."""
    output = Path(args.output)
    _check_output(output, args)
    import torch  # noqa: PLC0415

    from kornia_tidy.camera.tidy_optics import TiDyOptics  # noqa: PLC0415
    from kornia_tidy.masks.pixelwise import PixelwiseMask  # noqa: PLC0415
    from kornia_tidy.raw.dng_file import write_dng  # noqa: PLC0415

    stages = Stages()
    with stages("read"):
        camera, noise = _sensor(args), _noise(args)
        scene = read_scene(args)
    image = _channels_for(camera, scene.image)
    tell("scene", scene_in_words(scene))
    with torch.no_grad():
        with stages("PSFs"):
            optics = TiDyOptics(
                PixelwiseMask(args.masks, generator=torch.Generator().manual_seed(args.mask_seed)),
                camera=make_camera(args, scene),
                sensor=None,
                fidelity=args.fidelity,
                compositing=args.compositing,
            )
            bank = optics.psf_bank(channels=image.shape[0])
        tell("lens", optics.camera.extra_repr())
        tell("PSFs", light_in_words(bank, optics))
        color = args.color or ("camera" if args.like else "channels")
        with stages("capture"):
            raw = simulate_scene(
                image,
                scene.depth,
                optics,
                camera,
                noise,
                color=color,
                generator=torch.Generator().manual_seed(args.seed),
            )
    tell("clamped", clamped_in_words(optics, scene.depth))
    saturated = float((raw.counts >= int(raw.white)).float().mean())
    letters = raw.pattern_letters or "no"
    tell("sensor", f"{letters} filter array, white {raw.white:g}, {saturated:.2%} of the pixels there; {noise}")
    with stages("write"):
        write_dng(output, raw)
    tell("wrote", f"{output}, {raw.counts.shape[-1]} x {raw.counts.shape[-2]} px")
    tell("time", stages.summary())


def _sensor(args: argparse.Namespace) -> RawCapture:
    """Return the sensor of a raw file or of the options."""
    import torch  # noqa: PLC0415

    from kornia_tidy.raw.capture import RawCapture  # noqa: PLC0415
    from kornia_tidy.raw.color import srgb_from_xyz  # noqa: PLC0415

    if args.like is not None:
        for name in ("pattern", "bits", "black"):
            if getattr(args, name) is not None:
                raise ValueError(f"--like has a sensor of its own: leave out --{name}")
        return RawCapture.open(args.like, white=args.white)
    if args.white is not None:
        raise ValueError("--white is of the file of --like: give that, or --bits")
    bits = args.bits or BITS
    black = 2**bits // 16 if args.black is None else args.black
    camera = RawCapture.from_counts(torch.zeros(1, 2, 2), args.pattern or PATTERN, black, 2**bits - 1)
    if set(camera.colors) != set("RGB"):
        return camera
    # The camera's colours are declared to be those of the picture, so that a raw developer reproduces them.
    return replace(camera, xyz_to_camera=srgb_from_xyz().float(), white_balance=torch.ones(len(camera.colors)))


def _noise(args: argparse.Namespace) -> SensorNoise:
    from kornia_tidy.calibration.noise.photon_transfer import read_json  # noqa: PLC0415
    from kornia_tidy.sensor.noise import SensorNoise  # noqa: PLC0415

    if args.noise is None:
        return SensorNoise.physical(
            FULL_WELL if args.full_well is None else args.full_well,
            READ_NOISE if args.read_noise is None else args.read_noise,
            bits=16,
        )
    if args.full_well is not None or args.read_noise is not None:
        raise ValueError("--noise says full well and read noise: leave out --full-well and --read-noise")
    return read_json(args.noise).sensor_noise()


def _channels_for(camera: RawCapture, image: Any) -> Any:
    """Expand a grey picture to three channels for a colour camera."""
    if not camera.colors and image.shape[0] == 3:
        raise ValueError("a monochrome camera needs a grey picture: --image has colours")
    return image.expand(3, -1, -1) if camera.colors and image.shape[0] == 1 else image


def _check_output(output: Path, args: argparse.Namespace) -> None:
    if output.suffix.lower() != ".dng":
        raise ValueError(f"the output must be a .dng file, got {output}")
    check_outputs([output], [args.image, args.depth, args.like, args.noise])
