"""`kornia-tidy train`: joint training of phase masks and a reconstruction network."""

from __future__ import annotations

import argparse
import os
import sys
import textwrap
from dataclasses import fields
from pathlib import Path
from typing import Any

from kornia_tidy.commands.options import processes, seed
from kornia_tidy.commands.report import tell
from kornia_tidy.fidelity import PRESETS
from kornia_tidy.figures.learning_curve import draw_learning_curve
from kornia_tidy.inference.heads import CLOSED_FORMS, HEADS
from kornia_tidy.inference.tasks import MAPS
from kornia_tidy.masks.initial_heights import STARTS
from kornia_tidy.psf.psf_bank import STRAY_LIGHT
from kornia_tidy.reconstruction.closed_form import INVERSES
from kornia_tidy.render.compositing import COMPOSITING
from kornia_tidy.training.data_sets import SCENES
from kornia_tidy.training.design_folder import designed_camera, designed_settings
from kornia_tidy.training.lightning_extra import require_lightning
from kornia_tidy.training.settings import LEARN, NETWORK_RUN, PRECISIONS, SCHEDULES, TrainingSettings, usual_settings
from kornia_tidy.training.task_loss import LOSSES

CURVE = "learning_curve.png"

DESCRIPTION = """\
Learn the phase masks of a camera together with the network that reads its captures:
an all-in-focus image (edof), a depth map (depth), or both (joint).

Scenes are painted, like photographs (photographic-leaves) or with sharp outlines and full
textures (dead-leaves), or cut out of your own photographs in --root (photo-collages); or
read from --root: the frames of FlyingThings3D (flying-things), the paper's patches of them
(flying-things-patches), NYU Depth v2 (nyu), all as published, or your own folder
(rgbd-folder), in which rgbd.json gives the pairs of files and the unit of depth:
  {"image": "*.png", "depth": "*_depth.png", "scale": 0.001}
Published splits are kept; of a folder a tenth is for validation and a tenth for testing.
FlyingThings3D has no metric scale: its nearest points are put at the camera's near end.

--learn network trains the network alone, behind masks that stay as they start or are
designed (--design). Each scene is rendered once without noise and kept on the disk; crop,
gain, noise level and noise are drawn anew for each step, which then costs what the network
costs. Its defaults are for a CPU:
"""
DESCRIPTION += textwrap.fill(
    " ".join(
        f"--{name.replace('_', '-')}" + ("" if value is True else f" {value}")
        for name, value in NETWORK_RUN.items() if name != "learn" and value is not None
    ),
    88, initial_indent="  ", subsequent_indent="  ", break_on_hyphens=False,
)  # fmt: skip

EPILOG = """\
FOLDER gets settings.json, last.safetensors (to go on from), best.safetensors (weights of
the best epoch), training.csv, validation.csv, learning_curve.png, which tells at which
step the score levels off (with matplotlib), pictures of masks, PSFs and estimates in
pictures/, and a log for `tensorboard --logdir FOLDER`. After Ctrl-C or a power failure
--resume continues with the stored settings, and ends with the same weights as an
uninterrupted run (to the bit on one CPU process).

examples:
  The paper's extended depth of field, on scenes made here:
    kornia-tidy train --task edof --masks 5 --pretrain-epochs 300 -o outputs/edof
  A first look, in minutes on a CPU, for which the paper's network is too large:
    kornia-tidy train --task depth --head plain --size 96 --scenes 64 --batch 4 --epochs 5 \\
      -o outputs/look
  Extended depth of field in minutes on a CPU, from masks that are designed first:
    kornia-tidy train --task edof --start "focal sweep" --design 120 --refocus 5 --width 8 \\
      --residual --size 128 --scenes 480 --batch 6 --lr 2e-3 --lr-metres 6e-8 --epochs 10 \\
      -o outputs/swept
  A network behind five designed masks, in hours on a CPU; then both together:
    kornia-tidy train --learn network --start "focal sweep" --design 120 -o outputs/network
    kornia-tidy train --learn both --start "focal sweep" --design 120 --head nafnet --width 16 \\
      --closed-form --head-from outputs/network/best.safetensors --lr 2e-4 --size 128 --batch 4 \\
      -o outputs/both
  Masks again, for a network that has learnt, at a rate for masks that are good already:
    kornia-tidy train --learn masks --start "focal sweep" --lr-metres 4e-9 --batch 2 --epochs 2 \\
      --masks-from outputs/network/best.safetensors --head-from outputs/network/best.safetensors \\
      -o outputs/masks
  A network for the camera that `kornia-tidy design` recommends, and one for a lens without
  masks at f/48, both for 500 to 57,000 electrons of white at f/17.6 in the same time:
    kornia-tidy train --learn network --design-from outputs/design --electrons 500 57000 \\
      -o outputs/designed
    kornia-tidy train --learn network --masks 1 --start flat --f-number 48 --focus 0.74 \\
      --electrons 500 57000 -o outputs/flat
  Depth with its uncertainty, and the image, in some minutes on a CPU:
    kornia-tidy train --task joint --start "like fishers" --depth-classes 32 --refocus 11 --width 8 \\
      --size 128 --scenes 480 --batch 6 --lr 2e-3 --lr-metres 6e-8 --epochs 10 -o outputs/uncertain
  The paper's patches, by the loss of PhaseCam3D:
    kornia-tidy train --task depth --data flying-things-patches --root FlyingThings3D \\
      --loss phasecam3d --border valid -o outputs/depth
  Goes on after an interruption; a longer run may be asked for:
    kornia-tidy train --resume --epochs 400 -o outputs/edof
"""


def add_parser(subparsers: Any) -> None:
    """Describe the command to argparse."""
    parser = subparsers.add_parser(
        "train",
        help="learn masks and network together",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)
    parser.add_argument(
        "-o", "--output", default="outputs/train", metavar="FOLDER", help="made if missing (default: outputs/train)"
    )
    parser.add_argument("--resume", action="store_true", help="go on with the run in FOLDER, if there is one")
    parser.add_argument("--head-from", metavar="CHECKPOINT", help="begin with the network of another run")
    parser.add_argument(
        "--refiner-from", metavar="CHECKPOINT", help="begin --refined with the network of a run for the image alone"
    )
    parser.add_argument(
        "--masks-from", metavar="FILE", help="begin with the masks of another run, or of a camera that was saved"
    )
    parser.add_argument(
        "--design-from",
        metavar="FOLDER",
        help="lens, depth range and masks that kornia-tidy design recommends in FOLDER; options given here go first",
    )

    system = parser.add_argument_group("what is learnt")
    _setting(system, "task", choices=tuple(MAPS), help="edof, depth or joint")
    _setting(
        system,
        "learn",
        choices=tuple(LEARN),
        help="both: masks and network together; network: behind fixed masks, with captures rendered once; refiner: so, "
        "and only the second network of --refined; masks: through the network of --head-from, which stays as it is",
    )
    _setting(system, "masks", type=int, metavar="K", help="masks in one exposure; 0: a fixed Fresnel lens")
    _setting(
        system,
        "start",
        choices=STARTS,
        help="heights of the masks at first; Fisher suits depth, sweep edof; flat, with --masks 1: a lens alone",
    )
    _setting(system, "design", type=int, metavar="N", help="steps of mask design before training; edof only, 120 do")
    _add_network_settings(system)
    _setting(
        system,
        "loss",
        choices=tuple(LOSSES),
        help="mse: the paper's; l1: Ikoma's of depth; phasecam3d: 20 RMSE + RMSE of slopes; charbonnier: smooth l1; "
        "psnr-ssim: decibels of the error and of SSIM, for images",
    )
    _setting(system, "depth_weight", type=float, metavar="W", help="of the depth loss in the joint task")
    _setting(system, "image_weight", type=float, metavar="W", help="of the image loss in the joint task")

    data = parser.add_argument_group("scenes")
    add_scene_options(data)
    _setting(data, "scenes", type=int, metavar="N", help="number for training, of patches and scenes made here")
    _setting(data, "validation_scenes", type=int, metavar="N", help="number for validation, at most")
    _setting(data, "crop", type=int, metavar="PX", help="side of what a step sees of a scene; --learn network only")
    _add_noise_settings(data)
    data.add_argument(
        "--captures",
        metavar="FOLDER",
        help="of noise-free captures, which runs may share; --learn network only (default: in the run's)",
    )

    add_camera_settings(parser.add_argument_group("camera"))

    learning = parser.add_argument_group("learning")
    _setting(learning, "epochs", type=int, metavar="N", help="passes over the scenes")
    _setting(learning, "pretrain_epochs", type=int, metavar="N", help="before, with a fixed Fresnel lens")
    _setting(learning, "batch", type=int, metavar="B", help="scenes in a batch")
    _setting(learning, "accumulate", type=int, metavar="N", help="batches in a step")
    _setting(learning, "lr", type=float, metavar="LR", help="learning rate of the network")
    _setting(learning, "lr_metres", type=float, metavar="LR", help="learning rate of the masks, metres of height")
    _setting(learning, "schedule", choices=SCHEDULES, help="of both rates; cosine: up, then down to zero")
    _setting(learning, "ema", type=float, metavar="D", help="decay of the network's moving average; 0: none")
    _setting(learning, "patience", type=int, metavar="N", help="stop after N epochs without improvement")
    _setting(
        learning,
        "precision",
        choices=PRECISIONS,
        help="of the network; optics stay in float32. bf16-mixed is faster on processors that compute in bfloat16 "
        "(AMX or AVX-512 BF16: see lscpu), and far slower on others; default: 32-true",
    )
    _setting(
        learning,
        "channels_last",
        action=argparse.BooleanOptionalAction,
        help="the network's memory holds the channels of a pixel together: faster",
    )
    _setting(learning, "seed", type=seed, metavar="N", help="everything random follows from it")

    machine = parser.add_argument_group("machine")
    machine.add_argument("--accelerator", choices=("cpu", "gpu"), default="cpu", help="(default: cpu)")
    machine.add_argument("--devices", type=processes, default=1, metavar="N", help="processes (default: 1)")
    machine.add_argument(
        "--workers", type=processes, default=0, metavar="N", help="processes that load scenes (default: 0)"
    )
    machine.add_argument(
        "--save-every", type=int, default=100, metavar="N", help="steps between checkpoints in an epoch (default: 100)"
    )


def _add_network_settings(group: Any) -> None:
    """Add the options of the network and of its inputs."""
    _setting(
        group,
        "head",
        metavar="NAME",
        help=f"{', '.join(HEADS)}: networks (without a GPU take nafnet, plain or a small --width: the paper's "
        f"attention-unet has 34.9 million weights); {', '.join(CLOSED_FORMS)}: no network, only masks are learnt; "
        f"or module:Class, a class of yours that takes in_channels, out_channels and, if given, width",
    )
    _setting(
        group, "width", type=int, metavar="C", help="channels of its first level; default: its own, the paper's 64"
    )
    _setting(group, "repeats", type=int, metavar="N", help="factor of the number of blocks of nafnet; default: 1")
    _setting(
        group, "residual", action=argparse.BooleanOptionalAction, help="the network adds to the capture; not for depth"
    )
    _setting(
        group,
        "closed_form",
        action=argparse.BooleanOptionalAction,
        help="the network takes deconvolved captures and the level of the noise, and adds to the best of them",
    )
    _setting(
        group,
        "inverse",
        choices=INVERSES,
        help="filter of the deconvolved captures of --closed-form: wiener knows the spectrum of photographs and how "
        "PSFs differ between depths; default: wiener",
    )
    _setting(group, "refocus", type=int, metavar="D", help="depths that the capture is refocused to for the network")
    _setting(
        group,
        "depth_classes",
        type=int,
        metavar="D",
        help="joint: depth as a distribution over D classes, with its uncertainty, from --refocus depths; with "
        "--closed-form the default is 21 classes from 9 depths; without, 32 and 11 do; 0: one depth a pixel",
    )
    _setting(
        group,
        "refined",
        action=argparse.BooleanOptionalAction,
        help="a second network of the same kind refines the image; for a distribution of depth with --closed-form",
    )


def _add_noise_settings(group: Any) -> None:
    """Add the options of the noise where not masks and network are learnt together."""
    _setting(
        group,
        "noise_range",
        type=float,
        nargs=2,
        metavar=("LEAST", "LARGEST"),
        help="read noise, of full scale, drawn for half of the captures; not for --learn both",
    )
    _setting(
        group,
        "noise_error",
        type=float,
        metavar="X",
        help="largest factor by which the noise told to the network is wrong; default: 2.5; 1 for a camera whose noise "
        "is known; --learn network only",
    )
    _setting(
        group,
        "electrons",
        type=float,
        nargs=2,
        metavar=("LEAST", "LARGEST"),
        help="of white at --reference-f-number, drawn for the other half, which has shot noise: a smaller aperture "
        "gets fewer in the same exposure time; default: 500 to 60000 at any f-number; not for --learn both",
    )
    _setting(group, "reference_f_number", type=float, metavar="F", help="f-number of --electrons")


def add_scene_options(group: Any) -> None:
    """Add the options of scenes, with defaults from stored settings."""
    _setting(group, "data", choices=tuple(SCENES), help="where scenes come from")
    _setting(group, "root", metavar="FOLDER", help="folder of data that are files; default: data/NAME")
    _setting(group, "size", type=int, metavar="PX", help="side of the scenes; larger ones are cropped")


def add_camera_settings(group: Any) -> None:
    """Add the options of lens and sensor, with defaults from stored settings."""
    _setting(
        group,
        "depth_range",
        type=float,
        nargs=2,
        metavar=("NEAR", "FAR"),
        help="metres: focus and aperture are chosen to tell these depths apart; else 0.298 to inf",
    )
    _setting(group, "f_number", type=float, metavar="F", help="of the lens; default: 17.6, or by --depth-range")
    _setting(
        group,
        "focus",
        type=float,
        metavar="M",
        help="distance in focus, metres or inf; default: the middle of the range of 1/depth",
    )
    _setting(group, "focal_length", type=float, metavar="M", help="metres")
    _setting(group, "pixel_pitch", type=float, metavar="M", help="metres")
    _setting(group, "sigma", type=float, metavar="S", help="read noise, of full scale")
    _setting(group, "fidelity", choices=tuple(PRESETS), help="speed or accuracy")
    _setting(group, "window", type=int, metavar="PX", help="side of the PSFs, odd; default: measured on the masks")
    _setting(
        group, "stray_light", choices=STRAY_LIGHT, help="light outside the window; default: as the fidelity has it"
    )
    _setting(group, "compositing", choices=tuple(COMPOSITING), help="of depths")
    _setting(group, "border", choices=("reflect", "replicate", "zero", "circular", "valid"), help="beyond the scene")


def given_settings(args: argparse.Namespace) -> dict[str, Any]:
    """Return the settings given on the command line, without defaults."""
    return {field.name: getattr(args, field.name) for field in fields(TrainingSettings) if field.name in args}


def run(args: argparse.Namespace) -> None:
    """Train or resume a run, and print its results."""
    require_lightning()
    from kornia_tidy.training.callbacks import BEST, LAST  # noqa: PLC0415 (lightning takes seconds)
    from kornia_tidy.training.run import SETTINGS, train  # noqa: PLC0415

    for name in ("devices", "save_every"):
        if getattr(args, name) < 1:
            raise ValueError(f"--{name.replace('_', '-')} must be 1 or more, got {getattr(args, name)}")
    if (started := os.environ.get("WORLD_SIZE", str(args.devices))) != str(args.devices):
        raise ValueError(
            f"--devices must be the number of processes that torchrun started, WORLD_SIZE={started}, got {args.devices}"
        )
    folder = Path(args.output)
    given = given_settings(args)
    if args.design_from is not None:
        given = {**designed_settings(args.design_from), **given}
    if args.resume and (folder / SETTINGS).exists():
        settings = TrainingSettings.read(folder / SETTINGS).replace(**given)
    else:
        settings = TrainingSettings(**{**usual_settings(given), **given})
    if args.captures is not None and not settings.fixed_optics:
        raise ValueError(f"--captures is for --learn network or refiner, got --learn {settings.learn}")
    masks_from = args.masks_from
    if args.design_from is not None and masks_from is None and settings.masks:
        masks_from = designed_camera(args.design_from)
    say = tell if os.environ.get("LOCAL_RANK", "0") == "0" else _nothing  # only one process prints
    many = {"strategy": "ddp"} if args.devices > 1 else {}
    say("task", f"{settings.task}, {settings.masks} masks, head {settings.head!r}, data {settings.data!r}")
    say("learn", LEARN[settings.learn])
    goes_on = args.resume and (folder / LAST).exists()
    say("run", f"{folder}, {'goes on' if goes_on else 'new'}, {settings.epochs} epochs")
    try:
        module = train(
            settings,
            folder,
            resume=args.resume,
            head_from=args.head_from,
            refiner_from=args.refiner_from,
            masks_from=masks_from,
            captures=args.captures,
            save_every=args.save_every,
            workers=args.workers,
            progress=sys.stderr.isatty(),
            accelerator=args.accelerator,
            devices=args.devices,
            **many,
        )
    except KeyboardInterrupt:
        say("stopped", f"--resume -o {folder} goes on from the last checkpoint")
        raise
    finally:
        drawn = _draw_curve(folder)
    say("camera", module.optics.extra_repr())
    say("wrote", f"{folder / BEST}: evaluate this one")
    for name in (LAST, SETTINGS, "training.csv", "validation.csv", *drawn, "pictures"):
        say("", str(folder / name))


def _draw_curve(folder: Path) -> list[str]:
    """Draw the learning curve of a run and return its file, if matplotlib is there and an epoch was validated."""
    try:
        figure = draw_learning_curve(folder)
    except (ImportError, OSError, ValueError):
        return []
    figure.savefig(folder / CURVE, dpi=150)
    return [CURVE]


def _nothing(*_: str) -> None:
    """Ignore a report line."""


def _setting(group: Any, name: str, help: str, **options: Any) -> None:  # noqa: A002 (argparse calls it so)
    """Add an option for a setting without a default, so that stored settings remain unless it is given."""
    default = next(field.default for field in fields(TrainingSettings) if field.name == name)
    told = help if default is None else f"{help} (default: {default})"
    group.add_argument(f"--{name.replace('_', '-')}", dest=name, default=argparse.SUPPRESS, help=told, **options)
