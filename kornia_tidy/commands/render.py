"""`kornia-tidy render`: coded captures of a whole data set, written to disk."""

from __future__ import annotations

import argparse
import hashlib
import os
import sys
import time
from typing import Any

import torch
from tqdm import tqdm

from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.checks import check_positive
from kornia_tidy.coded_datasets.layout import BESIDE, Layout
from kornia_tidy.coded_datasets.render_scenes import render_scenes, shard_items_within
from kornia_tidy.commands.options import processes, seed
from kornia_tidy.commands.report import tell
from kornia_tidy.commands.training_options import (
    add_camera_settings,
    add_scene_options,
    given_settings,
    measured_camera_settings,
)
from kornia_tidy.files import read_bytes
from kornia_tidy.inference.trained import build_optics, load_trained
from kornia_tidy.systems.presets import SYSTEMS
from kornia_tidy.training.data_sets import SPLITS, make_scenes
from kornia_tidy.training.settings import TrainingSettings

OF_SCENES = ("data", "root", "size", "scenes", "validation_scenes", "depth_range", "seed")
OF_CAMERA = (
    "masks", "focal_length", "pixel_pitch", "depth_range", "sigma", "fidelity", "compositing", "border",
)  # fmt: skip
OF_MEASURED = ("full_well", "bits")  # known of a camera if its noise was measured
OF_PRESET = ("noise", "fidelity", "compositing", "border")  # options that replace a part of a published system

PLACES = (("RANK", "WORLD_SIZE"), ("SLURM_PROCID", "SLURM_NTASKS"))  # in the environment, by torchrun and by srun

DESCRIPTION = """\
Photograph every scene of a data set once through a camera with phase masks, and store
the captures for training. The camera is given by the options below, a published system
(--preset) or a trained one (--checkpoint).

FOLDER gets render.json (all settings), the captures, and index.csv once all captures
are complete:
  000123/coded.png, image.png, depth.npy, mask.png, scene.json     a folder for each scene
  00004.tar with 000123.coded.png, 000123.depth.npy, ...           --shard-...: WebDataset
Images are PNG of 16 bits, or with --float NPY (rows, columns, RGB) of float32; image is
the all-in-focus one; depth is NPY of float32 in metres, inf for a sky; the mask is 255
where depth is known.
"""

EPILOG = """\
After an interruption the same command continues and gives the same bytes, since captures
and shards are written atomically. A capture is determined by camera, scene, seed and
number alone, for any --jobs and any process (on processors of one kind). Processes of
torchrun or srun, or others with RANK and WORLD_SIZE in their environment, share the work,
on one machine or on several that share FOLDER. One that is done with its share takes over
what is missing: a process that is lost loses nothing.

examples:
  Scenes made here, through five random masks, on all of 8 cores:
    kornia-tidy render --scenes 1000 --jobs 8 -o captures
  The scenes that a training was not shown, through the masks it learnt, in shards:
    kornia-tidy render --checkpoint outputs/edof/best.safetensors --split test \\
        --shard-megabytes 500 -o captures
  Two machines with 16 processes each:
    torchrun --nnodes 2 --nproc-per-node 16 ... -m kornia_tidy.cli render ... -o captures
  The same by SLURM:
    srun --nodes 2 --ntasks-per-node 16 kornia-tidy render ... -o captures

In Python, in a data loader:
  from kornia_tidy.coded_datasets.captures import CodedCaptures
  CodedCaptures("captures")[0]        # {"coded", "image", "depth", "mask", "index", "name"}
"""


def add_parser(subparsers: Any) -> None:
    """Describe the command to argparse."""
    parser = subparsers.add_parser(
        "render",
        help="data set -> coded captures on disk",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)
    parser.add_argument("-o", "--output", required=True, metavar="FOLDER", help="made if missing")
    parser.add_argument(
        "--jobs", type=processes, default=1, metavar="N", help="processes that render here (default: 1)"
    )
    parser.add_argument("--noise-seed", type=seed, default=0, metavar="N", help="of the sensor's noise (default: 0)")

    files = parser.add_argument_group("files")
    files.add_argument(
        "--beside", nargs="*", choices=BESIDE, default=BESIDE, help="what lies beside the coded image (default: all)"
    )
    files.add_argument("--float", action="store_true", help="images as float32 NPY, not as 16-bit PNG")
    shards = files.add_mutually_exclusive_group()
    shards.add_argument("--shard-items", type=int, metavar="N", help="tar files of N captures, not folders")
    shards.add_argument(
        "--shard-megabytes", type=float, metavar="MB", help="tar files of about this size, judged by the first capture"
    )

    scenes = parser.add_argument_group("scenes", "With --checkpoint, defaults are those of the training.")
    add_scene_options(scenes)
    scenes.add_argument(
        "--split", choices=SPLITS, default="train", help="part of the data; all: of an rgbd-folder (default: train)"
    )
    scenes.add_argument(
        "--scenes",
        type=int,
        metavar="N",
        help="number of patches and scenes made here; of files at most, but of their train split all "
        "(default: the split's)",
    )

    camera = parser.add_argument_group("camera", f"With --preset: {', '.join(f'--{name}' for name in OF_PRESET)} only.")
    which = camera.add_mutually_exclusive_group()
    which.add_argument("--preset", choices=tuple(SYSTEMS), metavar="NAME", help=f"one of {', '.join(SYSTEMS)}")
    which.add_argument("--checkpoint", metavar="FILE", help="best.safetensors of a training")
    camera.add_argument(
        "--masks",
        type=int,
        default=argparse.SUPPRESS,
        metavar="K",
        help="random ones; 0: a Fresnel lens (default: 5)",
    )
    add_camera_settings(camera)
    camera.add_argument(
        "--seed",
        type=seed,
        default=argparse.SUPPRESS,
        metavar="N",
        help="of random masks and scenes made here (default: 0)",
    )


def run(args: argparse.Namespace) -> None:
    """Render the data set, and print a summary."""
    rank, world = _place()
    optics, settings, camera_from = _camera(args)
    scenes = make_scenes(settings, args.split, args.scenes)
    layout = Layout(tuple(args.beside), args.float, args.shard_items)
    if args.shard_megabytes is not None:
        check_positive("--shard-megabytes", args.shard_megabytes)
        size = int(args.shard_megabytes * 1e6)
        items = shard_items_within(optics, scenes, layout, size, args.noise_seed)
        layout = Layout(layout.beside, layout.floats, items)
    values = settings.as_dict()
    made_from = {**camera_from, "split": args.split, "scenes": {name: values[name] for name in OF_SCENES}}
    who = f", process {rank + 1} of {world}" if world > 1 else ""
    if rank == 0:
        tell("camera", optics.camera.extra_repr())
        tell("masks", optics.masks.extra_repr())
        tell("scenes", f"{len(scenes)} of {settings.data!r}, {args.split}")  # ty: ignore[invalid-argument-type]
    start = time.perf_counter()
    with tqdm(
        desc=f"render{who}", file=sys.stderr, leave=False, unit="scene", disable=None if rank == 0 else True
    ) as bar:

        def each(done: int, total: int) -> None:
            if bar.total is None:
                bar.total, bar.initial, bar.n = total, done - 1, done - 1
            bar.update(done - bar.n)

        try:
            made, found = render_scenes(
                optics, scenes, args.output, layout, seed=args.noise_seed, jobs=args.jobs, rank=rank, world=world,
                take_over=True, made_from=made_from, each=each,
            )  # fmt: skip
        except KeyboardInterrupt:
            bar.close()
            tell("stopped", "the same command goes on")
            raise
    seconds = time.perf_counter() - start
    before = f", {found} were there" if found else ""
    tell("wrote", f"{args.output}{who}: {made} captures in {seconds:.1f} s, {made / seconds:.2f} a second{before}")


def _camera(args: argparse.Namespace) -> tuple[TiDyOptics, TrainingSettings, dict[str, Any]]:
    """Return the camera, the settings of its scenes, and the origin of the camera."""
    measured, psfs = measured_camera_settings(args)
    given = {name: value for name, value in given_settings(args).items() if name != "scenes"} | measured
    if args.scenes is not None:
        given |= {"scenes": args.scenes, "validation_scenes": args.scenes}
    own = [name for name in OF_CAMERA if name in given]
    asked = ["psfs"] * (psfs is not None) + ["noise" if name == "sigma" else name for name in own]
    allowed, source = (OF_PRESET, "--preset") if args.preset else ((), "--checkpoint")
    if (args.preset or args.checkpoint) and (wrong := [name for name in asked if name not in allowed]):
        raise ValueError(f"--{wrong[0].replace('_', '-')} does not go with {source}, which has its own")
    if args.checkpoint:
        system = load_trained(args.checkpoint)
        digest = hashlib.sha256(read_bytes(args.checkpoint)).hexdigest()
        trained = TrainingSettings.of(system)
        if given.get("data", trained.data) != trained.data:
            given = {"root": None, **given}  # the stored folder belongs to the other data set
        return system.optics, trained.replace(**given), {"checkpoint": str(args.checkpoint), "sha256": digest}
    settings = TrainingSettings().replace(**given)
    if not args.preset:
        options = {name: getattr(settings, name) for name in (*OF_CAMERA, *(n for n in OF_MEASURED if n in given))}
        made_from: dict[str, Any] = {"options": options}
        if psfs is not None:
            made_from["psfs"] = hashlib.sha256(read_bytes(args.psfs)).hexdigest()
        return build_optics(settings, psfs), settings, made_from
    overrides: dict[str, Any] = {name: given[name] for name in own if name != "sigma"}
    if args.noise is not None:
        overrides["sensor"] = settings.sensor()
    noise = torch.Generator().manual_seed(settings.seed)
    optics = TiDyOptics.from_preset(args.preset, generator=noise, **overrides)
    seen = settings.replace(depth_range=getattr(optics.camera, "depth_range", None))
    return optics, seen, {"preset": args.preset, "options": {name: given[name] for name in own}}


def _place() -> tuple[int, int]:
    """Return the number of this process among those that share the work, and their number."""
    for rank, world in PLACES:
        if rank in os.environ:
            place = _whole(rank), _whole(world) if world in os.environ else 1
            if place[0] >= place[1]:
                raise ValueError(f"{rank} in the environment must be below {world}, {place[1]}, got {place[0]}")
            return place
    return 0, 1


def _whole(name: str) -> int:
    if not os.environ[name].isdecimal():
        raise ValueError(f"{name} in the environment must be a whole number, got {os.environ[name]!r}")
    return int(os.environ[name])
