"""Shared options of subcommands for scenes and cameras, and their conversion to objects of the library."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.checks import check_choice
from kornia_tidy.data.image_files import SUFFIXES
from kornia_tidy.data.rgbd import Scene, read_rgbd
from kornia_tidy.files import check_writable
from kornia_tidy.mask_export.mask_files import read_heights
from kornia_tidy.masks.pixelwise import PixelwiseMask
from kornia_tidy.optics.thin_lens import ThinLensCamera
from kornia_tidy.sensor.noise import SensorNoise

if TYPE_CHECKING:
    from kornia_tidy.calibration.noise.photon_transfer import PhotonTransfer

LENS_OPTIONS = ("focal_length", "aperture_diameter", "focus_distance", "pixel_pitch")
MASKS = 5  # in one exposure
MOST_PROCESSES = 1024  # more would exhaust a machine
MOST_MASKS = 1024  # PSFs of more masks take days


def add_depth_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that convert a depth file to metres."""
    group = parser.add_argument_group(
        "depth file",
        "Metres are stored value * scale or, for the disparity of a stereo pair,\n"
        "baseline * focal / (stored value * scale + doffs).",
    )
    group.add_argument(
        "--depth-scale",
        type=float,
        default=1.0,
        metavar="S",
        help="metres (or pixels of disparity) per stored unit; 0.001 for a 16-bit file in millimetres, 0.0002 "
        "for TUM's 5000 units per metre (default: 1)",
    )
    group.add_argument(
        "--depth-kind", choices=("depth", "disparity"), default="depth", help="what is stored (default: depth)"
    )
    group.add_argument(
        "--invalid",
        type=float,
        action="append",
        default=[],
        metavar="VALUE",
        help="stored value that means 'unknown', such as inf; may be repeated. NaN and a stored integer 0 always do. "
        "Unknown pixels take the depth of their nearest known neighbour",
    )
    group.add_argument(
        "--focal-px", type=float, metavar="PX", help="disparity: focal length of the stereo pair, pixels"
    )
    group.add_argument("--baseline-m", type=float, metavar="M", help="disparity: distance between its cameras, metres")
    group.add_argument(
        "--doffs-px", type=float, default=0.0, metavar="PX", help="disparity: offset of their principal points, pixels"
    )


def add_camera_options(parser: argparse.ArgumentParser) -> None:
    """Add the lens and the sensor's pixels, in SI units."""
    group = parser.add_argument_group(
        "camera",
        "Lengths in metres. Defocus, in radians at the edge of an aperture of radius R, is\n"
        "psi = pi R^2 / 530 nm * (1/depth - 1/focus): from +20 at 0.2975 m to -20 at\n"
        "infinity for the default lens. A scene that spans less of 1/depth needs a wider\n"
        "aperture to tell its depths apart: try --fit-depth.",
    )
    group.add_argument(
        "--fit-depth",
        action="store_true",
        help="choose focus and aperture so that this scene's depths (its middle 99 %%) fill psi = -20 to +20",
    )
    add_lens_options(group)
    group.add_argument(
        "--depth-range",
        type=float,
        nargs=2,
        metavar=("NEAR", "FAR"),
        help="depths that PSFs are prepared for; others are clamped to its ends (default: half the focus distance "
        "to inf)",
    )


def add_lens_options(group: argparse._ArgumentGroup) -> None:
    """Add options for lens and pixel pitch in SI units; missing defaults are those of the camera."""
    group.add_argument("--focal-length", type=float, metavar="M", help="longer enlarges the PSF (default: 0.05)")
    group.add_argument(
        "--aperture-diameter", type=float, metavar="M", help="wider blurs more out of focus (default: 0.002835, f/17.6)"
    )
    group.add_argument("--focus-distance", type=float, metavar="M", help="depth seen sharply (default: 0.595)")
    group.add_argument(
        "--pixel-pitch", type=float, metavar="M", help="smaller enlarges the PSF in pixels (default: 8e-6)"
    )


def add_mask_options(group: argparse._ArgumentGroup) -> None:
    """Add the options of the masks that are shown in one exposure."""
    group.add_argument(
        "--masks",
        type=masks,
        metavar="K|FILE",
        help=f"their number, of random height, or a file of their heights (default: {MASKS})",
    )
    group.add_argument("--mask-seed", type=seed, metavar="N", help="seed of random heights (default: 0)")


def add_noise_option(parser: Any, default: str) -> None:
    """Add the option of the sensor's noise, as a number or as it was measured.

    Args:
        parser: or a group of one.
        default: what is taken without it, in words.
    """
    parser.add_argument(
        "--noise",
        type=noise,
        metavar="S|FILE",
        help="standard deviation of the read noise in linear light, of full scale; or the file that 'kornia-tidy raw "
        f"calibrate-noise' wrote (default: {default})",
    )


def add_psfs_option(parser: Any, more: str = "") -> None:
    """Add the option of measured PSFs.

    Args:
        parser: or a group of one.
        more: to be added to the help.
    """
    parser.add_argument(
        "--psfs",
        metavar="FILE",
        help=f"the camera whose PSFs 'kornia-tidy raw calibrate-psf' measured: lens, masks and distances{more}",
    )


def noise(text: str) -> float | str:
    """Parse a noise: a number, or the file of a calibration.

    Example:
        >>> noise("0.01"), noise("iso800.json")
        (0.01, 'iso800.json')
    """
    try:
        value = float(text)
    except ValueError:
        return text
    if not 0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"a noise must be zero or positive and finite, of full scale, got {text}")
    return value


def masks(text: str) -> int | str:
    """Parse the number of masks, or the file of their heights."""
    return mask_count(text) if text.lstrip("+-").isdigit() else text


def seed(text: str) -> int:
    """Return a seed that a torch.Generator takes."""
    try:
        value = int(text)
    except ValueError:
        value = -1
    if not 0 <= value < 2**63:
        raise argparse.ArgumentTypeError(f"a seed must be a whole number from 0 to 2^63 - 1, got {text!r}")
    return value


def processes(text: str) -> int:
    """Parse a number of processes, from 0 to a safe maximum."""
    if not (text.isascii() and text.isdigit() and int(text[:9]) <= MOST_PROCESSES):
        raise argparse.ArgumentTypeError(f"must be a whole number from 0 to {MOST_PROCESSES}, got {text!r:.40}")
    return int(text)


def mask_count(text: str) -> int:
    """Parse the number of masks of one exposure, up to a safe maximum."""
    value = int(text)
    if value > MOST_MASKS:
        raise argparse.ArgumentTypeError(f"must be {MOST_MASKS} masks or fewer, got {text:.40}")
    return value


def read_scene(args: argparse.Namespace) -> Scene:
    """Read the image and depth named by the arguments."""
    return read_rgbd(
        args.image,
        args.depth,
        scale=args.depth_scale,
        kind=args.depth_kind,
        invalid=args.invalid,
        focal_px=args.focal_px,
        baseline_m=args.baseline_m,
        doffs_px=args.doffs_px,
    )


def read_noise(given: float | str | None) -> tuple[SensorNoise | None, PhotonTransfer | None]:
    """Return the sensor of ``--noise``, and the calibration if it was measured; None for what was not given.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file holds no calibration of the noise.
    """
    if given is None:
        return None, None
    if not isinstance(given, str):
        return SensorNoise(given), None
    from kornia_tidy.calibration.noise.photon_transfer import read_json  # noqa: PLC0415 (takes a second)

    if not Path(given).exists():
        raise FileNotFoundError(
            f"--noise is a number, of full scale, or a file of raw calibrate-noise: there is no file {given:.80}"
        )
    measured = read_json(given)
    return measured.sensor_noise(), measured


def make_optics(args: argparse.Namespace, scene: Scene | None, **options: Any) -> TiDyOptics:
    """Return the camera of the arguments: that which was measured, or one of lens and masks.

    Args:
        args: with the options of :func:`add_camera_options`, :func:`add_mask_options` and :func:`add_psfs_option`.
        scene: for ``--fit-depth``, if there is one.
        options: further ones of :class:`~kornia_tidy.TiDyOptics`.

    Raises:
        ValueError: if ``--psfs`` comes with an option for what was measured with them.
    """
    if args.psfs is not None:
        from kornia_tidy.calibration.psf.measured_camera import measured_camera  # noqa: PLC0415 (takes a second)

        refuse_with_psfs(args, (*LENS_OPTIONS, "depth_range", "fit_depth", "masks", "mask_seed"))
        return measured_camera(args.psfs, **options)
    if isinstance(args.masks, str):
        if args.mask_seed is not None:
            raise ValueError("--mask-seed is of masks of random height, and --masks is a file: leave one of them out")
        shown = PixelwiseMask(initial=read_heights(args.masks))
    else:
        generator = torch.Generator().manual_seed(args.mask_seed or 0)
        shown = PixelwiseMask(MASKS if args.masks is None else args.masks, generator=generator)
    return TiDyOptics(shown, camera=make_camera(args, scene), **options)


def refuse_with_psfs(args: argparse.Namespace, names: Sequence[str]) -> None:
    """Raise ``ValueError`` if an option was given for what ``--psfs`` says: lens, masks and distances."""
    for name in names:
        if (value := getattr(args, name, None)) is not None and value is not False:
            raise ValueError(f"--psfs has a lens, masks and distances of its own: leave out --{name.replace('_', '-')}")


def make_camera(args: argparse.Namespace, scene: Scene | None) -> ThinLensCamera:
    """Return the camera named by the arguments, or the one that fits the scene.

    Raises:
        ValueError: if ``--fit-depth`` comes with an option that it chooses, or no lens fits.
    """
    if not args.fit_depth:
        return make_lens(args, None if args.depth_range is None else tuple(args.depth_range))
    for name in ("aperture_diameter", "focus_distance", "depth_range"):
        if getattr(args, name) is not None:
            raise ValueError(f"--fit-depth chooses --{name.replace('_', '-')}: give one of the two")
    if scene is None:
        raise ValueError("--fit-depth needs a scene with a range of depths")
    given = {name: value for name in ("focal_length", "pixel_pitch") if (value := getattr(args, name)) is not None}
    return ThinLensCamera.for_scene(middle_depths(scene.depth, scene.valid), **given)


def make_lens(args: argparse.Namespace, depth_range: tuple[float, float] | None) -> ThinLensCamera:
    """Return the camera named by the arguments of :func:`add_lens_options`, for a range of depths."""
    given = {name: value for name in LENS_OPTIONS if (value := getattr(args, name)) is not None}
    return ThinLensCamera(depth_range=depth_range, **given)


def middle_depths(depth: Tensor, valid: Tensor) -> tuple[float, float]:
    """Return the nearest and farthest depth in metres without half a percent of the known pixels at either end.

    Percentiles are taken in dioptres, so that infinite depths are included.

    Raises:
        ValueError: if the whole scene lies at one depth.

    Example:
        >>> import torch
        >>> middle_depths(torch.tensor([[[1.0, 2.0, 4.0]]]), torch.tensor([[[True, True, False]]]))
        (1.0, 2.0)
    """
    ends = np.quantile(1 / depth[valid].double().numpy(), (0.995, 0.005), method="nearest")
    near, far = (float("inf") if end == 0 else float(1 / end) for end in ends)
    if not near < far:
        raise ValueError(f"--fit-depth needs a scene with a range of depths, this one lies at {near:.4g} m")
    return near, far


def check_output(path: str, *inputs: str | None, bits: int = 8) -> None:
    """Check before any work that a picture can be written to a path and does not replace an input.

    Raises:
        FileNotFoundError: if the folder does not exist.
        ValueError: if the suffix is not a picture's, cannot hold the bits, or the file is an input.
    """
    target = Path(path)
    suffix = target.suffix.lower()
    check_choice("the suffix of an image file", suffix, SUFFIXES)
    check_choice(f"bits of a {suffix} file", bits, (8,) if suffix in {".jpg", ".jpeg"} else (8, 16))
    check_writable(target)
    if target.exists() and any(other and Path(other).exists() and target.samefile(other) for other in inputs):
        raise ValueError(f"cannot write {path}: it is the input")
