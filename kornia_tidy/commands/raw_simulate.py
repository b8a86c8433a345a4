"""`kornia-tidy raw simulate`: simulation of a camera's raw file of a scene with depth, or of a calibration target."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from kornia_tidy.commands.options import (
    add_camera_options,
    add_depth_options,
    add_mask_options,
    add_noise_option,
    add_psfs_option,
    make_optics,
    read_noise,
    read_scene,
    seed,
)
from kornia_tidy.commands.raw_options import check_outputs, size
from kornia_tidy.commands.report import (
    Stages,
    clamped_in_words,
    light_in_words,
    masks_in_words,
    scene_in_words,
    tell,
)
from kornia_tidy.fidelity import PRESETS
from kornia_tidy.raw.point_targets import points_of_light
from kornia_tidy.raw.simulation import simulate_raw, simulate_scene
from kornia_tidy.render.compositing import COMPOSITING

if TYPE_CHECKING:
    import torch

    from kornia_tidy.raw.capture import RawCapture
    from kornia_tidy.sensor.noise import SensorNoise

DESCRIPTION = """\
Simulate the raw file of a camera with coded optics. The scene is a picture with a depth
map of the same size. It is blurred by the lens with its K phase masks, sampled through
the filter array, and recorded with the camera's noise, black and white level. The
result is an uncompressed DNG, which any raw software opens.

Instead of a scene, the targets of a calibration: an evenly lit sheet (--flat) for raw
calibrate-noise, or a sheet with pinholes (--points, --distance) for raw calibrate-psf.
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

  A dark capture, a flat, and 24 points at half a metre, to try out a calibration:
    kornia-tidy raw simulate --flat 0 -o dark.dng
    kornia-tidy raw simulate --flat 0.5 -o flat.dng
    kornia-tidy raw simulate --points 24 --distance 0.5 --size 1008x672 -o point0.5.dng

In Python: simulate_scene(image, depth, TiDyOptics(sensor=None), camera, noise)
"""

FULL_WELL, READ_NOISE = 10500.0, 2.4  # electrons: a small industrial sensor of 3.45 um pixels
PATTERN, BITS = "RGGB", 12
WIDTH, HEIGHT = 640, 480  # of a sheet
BRIGHTEST = 0.8  # of full scale, of points of light: as a laboratory exposes them


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
    parser.add_argument("-o", "--output", required=True, metavar="OUT.dng", help="DNG to write")
    target = parser.add_argument_group("what is photographed")
    kind = target.add_mutually_exclusive_group(required=True)
    kind.add_argument("--image", metavar="IMAGE", help="picture: PNG, JPEG, TIFF or NPY")
    kind.add_argument("--flat", type=float, metavar="L", help="an evenly lit sheet, of full scale; 0: the lens cap")
    kind.add_argument("--points", type=int, metavar="N", help="points of light in a sheet at --distance")
    target.add_argument("--depth", metavar="DEPTH", help="of the picture: PNG, TIFF, PGM, PFM, NPY, OpenEXR")
    target.add_argument("--distance", type=float, metavar="M", help="of the points, metres")
    target.add_argument("--size", type=size, metavar="WxH", help=f"of a sheet, in pixels (default: {WIDTH}x{HEIGHT})")

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
    add_noise_option(sensor, "by --full-well and --read-noise")
    sensor.add_argument(
        "--full-well", type=float, metavar="E", help=f"electrons that make white (default: {FULL_WELL:g})"
    )
    sensor.add_argument("--read-noise", type=float, metavar="E", help=f"electrons (default: {READ_NOISE:g})")
    sensor.add_argument("--seed", type=seed, default=0, metavar="N", help="seed of the noise (default: 0)")

    add_depth_options(parser)
    add_camera_options(parser)
    add_psfs_option(parser)
    masks = parser.add_argument_group("masks", "Random ones have 23 x 23 pixels: the start of training.")
    add_mask_options(masks)
    masks.add_argument("--fidelity", choices=tuple(PRESETS), default="balanced", help="(default: balanced)")
    masks.add_argument("--compositing", choices=tuple(COMPOSITING), default="gather", help="(default: gather)")


def run(args: argparse.Namespace) -> None:
    """Simulate the capture and write it."""
    output = Path(args.output)
    _check_arguments(output, args)
    import torch  # noqa: PLC0415

    from kornia_tidy.raw.dng_file import write_dng  # noqa: PLC0415

    stages = Stages()
    generator = torch.Generator().manual_seed(args.seed)
    with stages("read"):
        camera = _sensor(args)
        noise = _noise(args, camera)
    with torch.no_grad():
        if args.image is not None:
            raw = _scene(args, camera, noise, generator, stages)
        else:
            with stages("capture"):
                light = _target(args, 3 if camera.colors else 1, generator)
                raw = simulate_raw(light, camera, noise, color=_color(args), generator=generator)
    saturated = float((raw.counts >= int(raw.white)).float().mean())
    letters = raw.pattern_letters or "no"
    tell("sensor", f"{letters} filter array, white {raw.white:g}, {saturated:.2%} of the pixels there; {noise}")
    with stages("write"):
        write_dng(output, raw)
    tell("wrote", f"{output}, {raw.counts.shape[-1]} x {raw.counts.shape[-2]} px")
    tell("time", stages.summary())


def _scene(
    args: argparse.Namespace, camera: RawCapture, noise: SensorNoise, generator: torch.Generator, stages: Stages
) -> RawCapture:
    """Return the capture of a picture with depth."""
    with stages("read"):
        scene = read_scene(args)
    image = _channels_for(camera, scene.image)
    tell("scene", scene_in_words(scene))
    with stages("PSFs"):
        optics = make_optics(args, scene, sensor=None, fidelity=args.fidelity, compositing=args.compositing)
        bank = optics.psf_bank(channels=image.shape[0])
    tell("lens", optics.camera.extra_repr())
    tell("masks", masks_in_words(args, optics))
    tell("PSFs", light_in_words(bank, optics))
    with stages("capture"):
        raw = simulate_scene(image, scene.depth, optics, camera, noise, color=_color(args), generator=generator)
    tell("clamped", clamped_in_words(optics, scene.depth))
    return raw


def _target(args: argparse.Namespace, channels: int, generator: torch.Generator) -> torch.Tensor:
    """Return the light of a calibration target, (channels, rows, columns)."""
    import torch  # noqa: PLC0415

    rows, columns = (HEIGHT, WIDTH) if args.size is None else args.size
    if args.flat is not None:
        tell("target", f"an evenly lit sheet, {args.flat:g} of full scale")
        return torch.full((channels, rows, columns), args.flat)
    optics = make_optics(args, None, sensor=None, fidelity=args.fidelity)
    tell("lens", optics.camera.extra_repr())
    tell("target", f"{args.points} points of light at {args.distance:g} m, up to {BRIGHTEST:g} of full scale")
    return BRIGHTEST * points_of_light(optics, args.distance, args.points, (rows, columns), channels, generator)


def _color(args: argparse.Namespace) -> str:
    return args.color or ("camera" if args.like else "channels")


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


def _noise(args: argparse.Namespace, camera: RawCapture) -> SensorNoise:
    from kornia_tidy.sensor.noise import SensorNoise  # noqa: PLC0415

    if args.noise is None:
        return SensorNoise.physical(
            FULL_WELL if args.full_well is None else args.full_well,
            READ_NOISE if args.read_noise is None else args.read_noise,
            bits=16,
        )
    if args.full_well is not None or args.read_noise is not None:
        raise ValueError("--noise says full well and read noise: leave out --full-well and --read-noise")
    sensor, calibration = read_noise(args.noise)
    assert sensor is not None
    if calibration is not None and args.like is not None:
        calibration.check_taken_alike(camera, args.like)
    return sensor


def _channels_for(camera: RawCapture, image: Any) -> Any:
    """Expand a grey picture to three channels for a colour camera."""
    if not camera.colors and image.shape[0] == 3:
        raise ValueError("a monochrome camera needs a grey picture: --image has colours")
    return image.expand(3, -1, -1) if camera.colors and image.shape[0] == 1 else image


def _check_arguments(output: Path, args: argparse.Namespace) -> None:
    """Check before any work that the output can be written, and that the options are of one target."""
    if output.suffix.lower() != ".dng":
        raise ValueError(f"the output must be a .dng file, got {output}")
    noise = args.noise if isinstance(args.noise, str) else None
    check_outputs([output], [args.image, args.depth, args.like, noise, args.psfs])
    needs = {"--depth": ("image", args.depth), "--distance": ("points", args.distance)}
    for option, (target, value) in needs.items():
        if (value is None) != (getattr(args, target) is None):
            raise ValueError(f"--{target} and {option} go together, got only one of them")
    if args.image is not None and args.size is not None:
        raise ValueError("--size is of --flat and --points: a picture has its own")
    if args.flat is not None and not 0 <= args.flat <= 1:
        raise ValueError(f"--flat must be from 0 to 1, of full scale, got {args.flat:g}")
