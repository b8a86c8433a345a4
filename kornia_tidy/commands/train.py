"""`kornia-tidy train`: joint training of phase masks and a reconstruction network."""

from __future__ import annotations

import argparse
import os
import sys
import textwrap
from pathlib import Path
from typing import Any

from kornia_tidy.commands.options import processes, refuse_with_psfs, seed
from kornia_tidy.commands.report import tell
from kornia_tidy.commands.training_options import (
    add_camera_settings,
    add_network_settings,
    add_noise_settings,
    add_scene_options,
    add_setting,
    given_settings,
    measured_camera_settings,
)
from kornia_tidy.figures.learning_curve import draw_learning_curve
from kornia_tidy.inference.tasks import MAPS
from kornia_tidy.masks.initial_heights import STARTS
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
  A network for a camera that was measured:
    kornia-tidy train --learn network --psfs bank.safetensors --noise iso800.json -o outputs/mine
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
    add_setting(system, "task", choices=tuple(MAPS), help="edof, depth or joint")
    add_setting(
        system,
        "learn",
        choices=tuple(LEARN),
        help="both: masks and network together; network: behind fixed masks, with captures rendered once; refiner: so, "
        "and only the second network of --refined; masks: through the network of --head-from, which stays as it is",
    )
    add_setting(system, "masks", type=int, metavar="K", help="masks in one exposure; 0: a fixed Fresnel lens")
    add_setting(
        system,
        "start",
        choices=STARTS,
        help="heights of the masks at first; Fisher suits depth, sweep edof; flat, with --masks 1: a lens alone",
    )
    add_setting(
        system, "mask_size", type=int, metavar="N", help="pixels along a side of a mask, 20 of 23 across the aperture"
    )
    add_setting(system, "design", type=int, metavar="N", help="steps of mask design before training; edof only, 120 do")
    add_network_settings(system)
    add_setting(
        system,
        "loss",
        choices=tuple(LOSSES),
        help="mse: the paper's; l1: Ikoma's of depth; phasecam3d: 20 RMSE + RMSE of slopes; charbonnier: smooth l1; "
        "psnr-ssim: decibels of the error and of SSIM, for images",
    )
    add_setting(
        system,
        "depth_weight",
        type=float,
        metavar="W",
        help="of the depth loss in the joint task; beside psnr-ssim, which is in decibels, 10 or more",
    )
    add_setting(system, "image_weight", type=float, metavar="W", help="of the image loss in the joint task")

    data = parser.add_argument_group("scenes")
    add_scene_options(data)
    add_setting(data, "scenes", type=int, metavar="N", help="number for training, of patches and scenes made here")
    add_setting(data, "validation_scenes", type=int, metavar="N", help="number for validation, at most")
    add_setting(data, "crop", type=int, metavar="PX", help="side of what a step sees of a scene; --learn network only")
    add_noise_settings(data)
    data.add_argument(
        "--captures",
        metavar="FOLDER",
        help="of noise-free captures, which runs may share; --learn network only (default: in the run's)",
    )

    add_camera_settings(parser.add_argument_group("camera"))

    learning = parser.add_argument_group("learning")
    add_setting(learning, "epochs", type=int, metavar="N", help="passes over the scenes")
    add_setting(learning, "pretrain_epochs", type=int, metavar="N", help="before, with a fixed Fresnel lens")
    add_setting(learning, "batch", type=int, metavar="B", help="scenes in a batch")
    add_setting(learning, "accumulate", type=int, metavar="N", help="batches in a step")
    add_setting(learning, "lr", type=float, metavar="LR", help="learning rate of the network")
    add_setting(learning, "lr_metres", type=float, metavar="LR", help="learning rate of the masks, metres of height")
    add_setting(learning, "schedule", choices=SCHEDULES, help="of both rates; cosine: up, then down to zero")
    add_setting(learning, "ema", type=float, metavar="D", help="decay of the network's moving average; 0: none")
    add_setting(learning, "patience", type=int, metavar="N", help="stop after N epochs without improvement")
    add_setting(
        learning,
        "precision",
        choices=PRECISIONS,
        help="of the network; optics stay in float32. bf16-mixed is faster on processors that compute in bfloat16 "
        "(AMX or AVX-512 BF16: see lscpu), and far slower on others; default: 32-true",
    )
    add_setting(
        learning,
        "channels_last",
        action=argparse.BooleanOptionalAction,
        help="the network's memory holds the channels of a pixel together: faster",
    )
    add_setting(learning, "seed", type=seed, metavar="N", help="everything random follows from it")

    machine = parser.add_argument_group("machine")
    machine.add_argument("--accelerator", choices=("cpu", "gpu"), default="cpu", help="(default: cpu)")
    machine.add_argument("--devices", type=processes, default=1, metavar="N", help="processes (default: 1)")
    machine.add_argument(
        "--workers", type=processes, default=0, metavar="N", help="processes that load scenes (default: 0)"
    )
    machine.add_argument(
        "--save-every", type=int, default=100, metavar="N", help="steps between checkpoints in an epoch (default: 100)"
    )


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
    measured, psfs = measured_camera_settings(args)
    if psfs is not None:
        refuse_with_psfs(args, ("design_from", "masks_from"))
    given = {**given_settings(args), **measured}
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
            psfs=psfs,
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
