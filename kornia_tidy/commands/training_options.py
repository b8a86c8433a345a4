"""Options of the command line that are training's settings, for every command that takes some of them."""

from __future__ import annotations

import argparse
from dataclasses import fields
from typing import Any

from kornia_tidy.commands.options import add_noise_option, add_psfs_option, read_noise, refuse_with_psfs
from kornia_tidy.fidelity import PRESETS
from kornia_tidy.inference.heads import CLOSED_FORMS, HEADS
from kornia_tidy.psf.psf_bank import STRAY_LIGHT, PSFBank
from kornia_tidy.reconstruction.closed_form import INVERSES
from kornia_tidy.render.compositing import COMPOSITING
from kornia_tidy.training.data_sets import SCENES
from kornia_tidy.training.settings import TrainingSettings

OF_MEASURED = (
    "masks", "start", "mask_size", "design", "focal_length", "pixel_pitch", "depth_range", "f_number", "focus",
    "window", "stray_light",
)  # fmt: skip
"""Settings of a camera that are measured with its PSFs."""


def add_setting(group: Any, name: str, help: str, **options: Any) -> None:  # noqa: A002 (argparse calls it so)
    """Add an option for a setting without a default, so that stored settings remain unless it is given."""
    default = next(field.default for field in fields(TrainingSettings) if field.name == name)
    told = help if default is None else f"{help} (default: {default})"
    group.add_argument(f"--{name.replace('_', '-')}", dest=name, default=argparse.SUPPRESS, help=told, **options)


def add_network_settings(group: Any) -> None:
    """Add the options of the network and of its inputs."""
    add_setting(
        group,
        "head",
        metavar="NAME",
        help=f"{', '.join(HEADS)}: networks (without a GPU take nafnet, plain or a small --width: the paper's "
        f"attention-unet has 34.9 million weights); {', '.join(CLOSED_FORMS)}: no network, only masks are learnt; "
        f"or module:Class, a class of yours that takes in_channels, out_channels and, if given, width",
    )
    add_setting(
        group, "width", type=int, metavar="C", help="channels of its first level; default: its own, the paper's 64"
    )
    add_setting(group, "repeats", type=int, metavar="N", help="factor of the number of blocks of nafnet; default: 1")
    add_setting(
        group, "residual", action=argparse.BooleanOptionalAction, help="the network adds to the capture; not for depth"
    )
    add_setting(
        group,
        "closed_form",
        action=argparse.BooleanOptionalAction,
        help="the network takes deconvolved captures and the level of the noise, and adds to the best of them",
    )
    add_setting(
        group,
        "inverse",
        choices=INVERSES,
        help="filter of the deconvolved captures of --closed-form: wiener knows the spectrum of photographs and how "
        "PSFs differ between depths; default: wiener",
    )
    add_setting(group, "refocus", type=int, metavar="D", help="depths that the capture is refocused to for the network")
    add_setting(
        group,
        "fine",
        action=argparse.BooleanOptionalAction,
        help="refocus twice to each depth of --refocus, the second time sharper and with more noise, for --closed-form",
    )
    add_setting(
        group,
        "depth_classes",
        type=int,
        metavar="D",
        help="joint: depth as a distribution over D classes, with its uncertainty, from --refocus depths; with "
        "--closed-form the default is 21 classes from 9 depths; without, 32 and 11 do; 0: one depth a pixel",
    )
    add_setting(
        group,
        "refined",
        action=argparse.BooleanOptionalAction,
        help="a second network of the same kind refines the image; for a distribution of depth with --closed-form",
    )


def add_noise_settings(group: Any) -> None:
    """Add the options of the noise where not masks and network are learnt together."""
    add_setting(
        group,
        "noise_range",
        type=float,
        nargs=2,
        metavar=("LEAST", "LARGEST"),
        help="read noise, of full scale, drawn for half of the captures; not for --learn both",
    )
    add_setting(
        group,
        "noise_error",
        type=float,
        metavar="X",
        help="largest factor by which the noise told to the network is wrong; default: 2.5; 1 for a camera whose noise "
        "is known; --learn network only",
    )
    add_setting(
        group,
        "electrons",
        type=float,
        nargs=2,
        metavar=("LEAST", "LARGEST"),
        help="of white at --reference-f-number, drawn for the other half, which has shot noise: a smaller aperture "
        "gets fewer in the same exposure time; default: 500 to 60000 at any f-number; not for --learn both",
    )
    add_setting(group, "reference_f_number", type=float, metavar="F", help="f-number of --electrons")


def add_scene_options(group: Any) -> None:
    """Add the options of scenes, with defaults from stored settings."""
    add_setting(group, "data", choices=tuple(SCENES), help="where scenes come from")
    add_setting(group, "root", metavar="FOLDER", help="folder of data that are files; default: data/NAME")
    add_setting(group, "size", type=int, metavar="PX", help="side of the scenes; larger ones are cropped")


def add_camera_settings(group: Any) -> None:
    """Add the options of lens and sensor, with defaults from stored settings."""
    add_setting(
        group,
        "depth_range",
        type=float,
        nargs=2,
        metavar=("NEAR", "FAR"),
        help="metres: focus and aperture are chosen to tell these depths apart; else 0.298 to inf",
    )
    add_setting(group, "f_number", type=float, metavar="F", help="of the lens; default: 17.6, or by --depth-range")
    add_setting(
        group,
        "focus",
        type=float,
        metavar="M",
        help="distance in focus, metres or inf; default: the middle of the range of 1/depth",
    )
    add_setting(group, "focal_length", type=float, metavar="M", help="metres")
    add_setting(group, "pixel_pitch", type=float, metavar="M", help="metres")
    add_psfs_option(group)
    add_noise_option(group, "0.01")
    add_setting(group, "fidelity", choices=tuple(PRESETS), help="speed or accuracy")
    add_setting(group, "window", type=int, metavar="PX", help="side of the PSFs, odd; default: measured on the masks")
    add_setting(
        group, "stray_light", choices=STRAY_LIGHT, help="light outside the window; default: as the fidelity has it"
    )
    add_setting(group, "compositing", choices=tuple(COMPOSITING), help="of depths")
    add_setting(group, "border", choices=("reflect", "replicate", "zero", "circular", "valid"), help="beyond the scene")


def given_settings(args: argparse.Namespace) -> dict[str, Any]:
    """Return the settings given on the command line, without defaults."""
    return {field.name: getattr(args, field.name) for field in fields(TrainingSettings) if field.name in args}


def measured_camera_settings(args: argparse.Namespace) -> tuple[dict[str, Any], PSFBank | None]:
    """Return the settings of the camera that ``--psfs`` and ``--noise`` say, and the measured PSFs, if any.

    Raises:
        FileNotFoundError: if a file is not there.
        ValueError: if a file is of another kind, or an option was given for what was measured with the PSFs.
    """
    from kornia_tidy.calibration.psf.measured_psfs import MeasuredPSFs  # noqa: PLC0415 (takes a second)
    from kornia_tidy.inference.measured import measured_settings, noise_settings  # noqa: PLC0415

    sensor, _ = read_noise(args.noise)
    settings = {} if sensor is None else noise_settings(sensor)
    if args.psfs is None:
        return settings, None
    refuse_with_psfs(args, OF_MEASURED)
    measured = MeasuredPSFs.load(args.psfs)
    return {**settings, **measured_settings(measured)}, measured.bank
