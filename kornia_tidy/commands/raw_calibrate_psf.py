"""`kornia-tidy raw calibrate-psf`: measurement of PSFs from pictures of a point of light at known distances."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from kornia_tidy.checks import check_choice, check_positive
from kornia_tidy.commands.options import add_lens_options, add_noise_option, make_lens, read_noise
from kornia_tidy.commands.raw_options import add_dump_options, check_outputs, open_raw
from kornia_tidy.commands.report import Stages, tell
from kornia_tidy.data.image_files import SUFFIXES, read_image
from kornia_tidy.files import check_file, replacing
from kornia_tidy.optics.thin_lens import ThinLensCamera
from kornia_tidy.sensor.noise import SensorNoise

if TYPE_CHECKING:
    from kornia_tidy.calibration.noise.photon_transfer import PhotonTransfer
    from kornia_tidy.calibration.psf.point_images import Tile

DESCRIPTION = """\
Measure the PSFs of a camera from pictures of a point of light at known distances.
At each distance the point is moved by some pixels and fractions of a pixel between
the pictures: an undersampled PSF can only be reconstructed from several of them, and
dust on the sensor stays where it is. 16 positions are good, 24 behind a filter array;
they need not be known. Several exposures at each
position, the longer ones saturated, measure the faint parts of a PSF as well. FILES
are raw files or 16-bit images of linear light without black level, sorted by
distance, then by position of the point, then by exposure. The planes of one colour of
a filter array give one PSF on the pixel grid of the sensor, so that the bank has red,
green and blue.
"""

EXAMPLES = """\
examples:
  Three distances, 8 places of the point at each:
    kornia-tidy raw calibrate-psf d1_*.dng d2_*.dng d3_*.dng \\
        --distances 0.35 0.6 1.5 --noise iso800.json -o bank.safetensors

  Two exposures at each position; the same positions with a flat modulator, which give
  the position of the chief ray; and retrieval of the mask behind these PSFs:
    kornia-tidy raw calibrate-psf p*.tif --distances 0.35 0.6 1.5 --exposures 0.01 0.08 \\
        --full-well 10500 --read-noise 2.4 --reference flat*.tif -o bank.safetensors \\
        --picture bank.png --fit-mask mask.npy

The printed numbers show the accuracy of the bank. "noise" is the expected error, as the
sum of its moduli relative to the PSF's light. "residuals" of about 1 mean that the
pictures of one distance are consistent. Far larger ones mean that something moved or
that --full-well, --read-noise or the black level are wrong. Most of the error of a
sharp PSF is noise in its dark surroundings: one more exposure, four times as long,
lowers it as much as twice the number of positions. Without --reference each PSF is
centred at its centroid, and shifts by the masks are not measured.

In Python:
  bank = PSFBank.load("bank.safetensors")
  coded = TiDyOptics(camera=..., sensor=...).with_bank(bank)(image, depth)
  sharp = Tikhonov()(capture, bank)  # of linear light
  MeasuredPSFs.load("bank.safetensors").uncertainty  # and .distances, .reports of every picture
"""


GOOD_NOISE = 0.02  # in L1


def add_parser(subparsers: Any) -> None:
    """Describe the subcommand to argparse."""
    parser = subparsers.add_parser(
        "calibrate-psf",
        help="pictures of a point -> PSF bank",
        description=DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("files", nargs="+", metavar="FILES", help="raw files, or 16-bit images of linear light")
    parser.add_argument("--distances", type=float, nargs="+", required=True, metavar="M", help="of the point, metres")
    parser.add_argument(
        "--exposures", type=float, nargs="+", default=[1.0], metavar="S", help="at each place, seconds (default: one)"
    )
    parser.add_argument("-o", "--output", required=True, metavar="OUT", help="bank to write, .safetensors")
    parser.add_argument("--reference", nargs="+", metavar="FILE", help="the same places with a flat mask, unsaturated")
    parser.add_argument(
        "--window", type=int, default=41, metavar="P", help="side of the PSFs, pixels of the sensor (default: 41)"
    )
    parser.add_argument("--points", type=int, default=1, metavar="N", help="points in each picture (default: 1)")
    parser.add_argument("--picture", metavar="PNG", help="draw PSFs, uncertainties and residuals")
    parser.add_argument("--fit-mask", metavar="NPY", help="find the mask behind the PSFs and write its heights, metres")
    parser.add_argument("--mask-size", type=int, default=23, metavar="N", help="its pixels along a side (default: 23)")
    parser.add_argument(
        "--diameter", type=float, default=0.0, metavar="M", help="of the point of light, metres (default: 0)"
    )
    noise = parser.add_argument_group("noise of the sensor")
    noise.add_argument("--full-well", type=float, metavar="E", help="electrons from black to white")
    noise.add_argument("--read-noise", type=float, metavar="E", help="electrons")
    add_noise_option(noise, "by --full-well and --read-noise")
    add_lens_options(parser.add_argument_group("camera", "Lengths in metres."))
    add_dump_options(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Measure the PSFs and write the bank."""
    from kornia_tidy.calibration.psf.measured_psfs import measure_psfs  # noqa: PLC0415 (only who measures waits for it)

    places = _check_arguments(args)
    camera = make_lens(args, (0.99 * min(args.distances), 1.01 * max(args.distances)))
    stages = Stages()
    with stages("measure"):
        images = _images(args, places)
        channels = 1 + max(next(iter(images.values()))[0].channels)
        measured = measure_psfs(images, camera, args.window, _cutoff(camera, channels), args.diameter)
    tell("camera", camera.extra_repr())
    for report in measured.reports:
        if report.rejected is not None:
            where = f"row {report.row:.1f}, column {report.column:.1f}"
            tell("left out", f"the point at {report.distance:g} m, {where}: {report.rejected}")
    noise = (2 / torch.pi) ** 0.5 * measured.uncertainty.sum((2, 3))
    for distance, psi, own in zip(measured.distances, measured.bank.defocus, noise, strict=True):
        used = [r for r in measured.reports if r.distance == float(distance) and r.rejected is None]
        times = (sum(r.misfit or 0.0 for r in used) / len(used)) ** 0.5
        words = " ".join(f"{100 * float(x):.2g}" for x in own)
        where = f"{float(distance):g} m, psi {float(psi):+.2f} rad"
        tell("PSF", f"{where}: {len(used)} point images, residuals {times:.2g} times the noise, noise {words} % in L1")
        worst = float(own.max())
        if worst > GOOD_NOISE:
            more = math.ceil(len(used) * (worst / GOOD_NOISE) ** 2)
            tell("", f"about {more} point images, or one more and far longer exposure, bring it to {GOOD_NOISE:.0%}")
    measured.save(args.output)
    tell("wrote", f"{args.output}, PSFs sum to one: light outside their {args.window} x {args.window} px is not seen")
    fit = None
    if args.fit_mask is not None:
        from kornia_tidy.calibration.psf.phase_retrieval import retrieve_mask  # noqa: PLC0415
        from kornia_tidy.mask_export.mask_files import write_heights  # noqa: PLC0415

        with stages("mask"):
            fit = retrieve_mask(measured.bank, camera, _spectrum(channels), args.mask_size)
        for distance, left in zip(measured.distances, fit.residual, strict=True):
            words = " ".join(f"{100 * float(x):.2g}" for x in left)
            tell("mask", f"{float(distance):g} m: leaves {words} % in L1")
        write_heights(args.fit_mask, fit.lens.masks.heights().detach())
        tell("wrote", args.fit_mask)
    if args.picture is not None:
        from kornia_tidy.figures.measured_psfs import draw_measured  # noqa: PLC0415

        with replacing(args.picture) as temporary:
            draw_measured(measured, fit).savefig(temporary, dpi=150, format="png")
        tell("wrote", args.picture)
    tell("time", stages.summary())


def _check_arguments(args: argparse.Namespace) -> int:
    """Check the arguments before any work; return the number of point positions at each distance."""
    for path, suffix in ((args.output, ".safetensors"), (args.picture, ".png"), (args.fit_mask, ".npy")):
        if path is not None:
            check_choice("the suffix of what to write", Path(path).suffix.lower(), (suffix,))
    inputs = [*args.files, *(args.reference or [])]
    check_outputs([args.output, args.picture, args.fit_mask], inputs)
    if len(set(args.distances)) != len(args.distances) or not min(args.distances) > 0:
        raise ValueError(f"--distances must be different metres above zero, got {args.distances}")
    groups = len(args.distances) * len(args.exposures)
    if len(args.files) % groups:
        raise ValueError(
            f"{len(args.files)} files do not divide into {len(args.distances)} distances with {len(args.exposures)} "
            f"exposures at each place"
        )
    places = len(args.files) // groups
    for path in inputs:
        check_file(path)
    if args.fit_mask is not None:
        check_positive("--mask-size", args.mask_size)
        if len(args.distances) < 2:
            raise ValueError("--fit-mask needs two distances or more: one does not tell a mask from its twin")
    if args.reference is not None and len(args.reference) != places * len(args.distances):
        raise ValueError(
            f"--reference needs one file for each of {places * len(args.distances)} places, got {len(args.reference)}"
        )
    return places


def _images(args: argparse.Namespace, places: int) -> dict[float, list[Any]]:
    """Read the pictures of one position after another, and keep only crops around the points."""
    from kornia_tidy.calibration.psf.point_images import point_images  # noqa: PLC0415

    sensor, calibration = _sensor(args)
    exposures = torch.tensor(args.exposures)
    files = iter(args.files)
    references = iter(args.reference or [])
    images: dict[float, list[Any]] = {}
    for distance in args.distances:
        images[distance] = []
        for _ in range(places):
            frames, tiles = zip(*[_read(next(files), args, calibration) for _ in args.exposures], strict=True)
            if len({frame.shape for frame in frames}) > 1:
                raise ValueError(f"the exposures of one place differ in size: {[tuple(f.shape) for f in frames]}")
            reference = _read(next(references), args)[0] if args.reference else None
            images[distance] += point_images(
                torch.stack(frames), exposures, sensor, args.window, args.points, reference, tiles[0]
            )
    return images


def _sensor(args: argparse.Namespace) -> tuple[SensorNoise, PhotonTransfer | None]:
    """Return the noise of the arguments, and its calibration if it was measured."""
    given = args.full_well, args.read_noise
    if args.noise is None:
        if None in given:
            raise ValueError("the noise of the sensor is needed: --noise, or --full-well and --read-noise")
        return SensorNoise.physical(*given), None
    if given != (None, None):
        raise ValueError("--noise says full well and read noise: leave out --full-well and --read-noise")
    sensor, calibration = read_noise(args.noise)
    assert sensor is not None
    return sensor, calibration


def _read(path: str, args: argparse.Namespace, calibration: PhotonTransfer | None = None) -> tuple[Tensor, Tile | None]:
    """Read linear light (C, H, W) or, for a mosaic, the planes of its tile with their channels."""
    if Path(path).suffix.lower() in SUFFIXES:
        return read_image(path), None
    raw = open_raw(path, args)
    if calibration is not None:
        calibration.check_taken_alike(raw, path)
    rows, columns = raw.tile
    if (rows, columns) not in {(1, 1), (2, 2)}:
        raise ValueError(f"cannot measure PSFs on {path}: its tile is {rows}x{columns}, 2x2 or none is needed")
    if raw.pattern is None:
        return raw.planes(), None
    letters = "".join(dict.fromkeys(raw.colors))  # both greens are one channel
    return raw.planes(), tuple(tuple(letters.index(raw.colors[color]) for color in row) for row in raw.pattern)


def _cutoff(camera: ThinLensCamera, channels: int) -> list[float]:
    """Return the cutoff frequency of the lens at the shortest wavelength of the channels."""
    from kornia_tidy.calibration.psf.measured_psfs import diffraction_cutoff  # noqa: PLC0415

    shortest = {3: (570e-9, 480e-9, 400e-9)}.get(channels, (400e-9,) * channels)
    return [min(2.0, diffraction_cutoff(camera, wave)) for wave in shortest]


def _spectrum(channels: int) -> Any:
    from kornia_tidy.optics.spectrum import Spectrum  # noqa: PLC0415

    if channels not in {1, 3}:
        raise ValueError(f"--fit-mask needs PSFs of 1 or 3 channels, these have {channels}")
    return Spectrum.monochrome() if channels == 1 else Spectrum.rgb()
