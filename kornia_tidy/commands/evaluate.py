"""`kornia-tidy evaluate`: error measures of a trained system on test scenes."""

from __future__ import annotations

import argparse
import sys
from itertools import count
from pathlib import Path
from typing import Any

from tqdm import tqdm

from kornia_tidy.commands.options import add_noise_option, add_psfs_option, read_noise, seed
from kornia_tidy.commands.report import tell
from kornia_tidy.commands.system_options import load_system
from kornia_tidy.commands.training_options import add_scene_options, given_settings
from kornia_tidy.inference.heads import CLOSED_FORMS
from kornia_tidy.inference.pretrained import PRETRAINED
from kornia_tidy.inference.tasks import MAPS
from kornia_tidy.training.data_sets import make_scenes
from kornia_tidy.training.evaluation import SceneResult, draw_scene, evaluate, metric_range, table, write_table
from kornia_tidy.training.settings import TrainingSettings

DESCRIPTION = """\
Evaluate a trained camera and network, or the closed form of a camera that was measured,
on scenes that were not used for training. With --psfs and --noise the captures are those
of the measured camera, and a network that deconvolves them is told its PSFs. FOLDER
gets results.csv (one line per scene), summary.json (means and settings), and pictures of
the first scenes: capture, estimates, ground truth, and errors times 3.

image_rmse, image_psnr (dB), image_ssim: of the image in [0, 1], without clipping.
depth_rmse: of normalised inverse depth, 0 at the far and 1 at the near end of the
  camera's range; depth_rmse_radians: of the corresponding defocus.
depth_rmse_metres, depth_abs_rel, depth_log10, depth_delta1 to 3 (within 1.25, 1.25^2 and
  1.25^3): of depth in metres, over pixels of known depth within the camera's range. A
  range that reaches to infinity ends at 32 times its near end. Estimates are clamped to
  the range. depth_counted: share of the pixels evaluated.
"""


def add_parser(subparsers: Any) -> None:
    """Describe the command to argparse."""
    parser = subparsers.add_parser(
        "evaluate",
        help="error measures of a trained system",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)
    parser.add_argument(
        "checkpoint",
        metavar="SYSTEM",
        help=f"best.safetensors or last.safetensors of a run; {', '.join(PRETRAINED)}; or with --psfs "
        f"{', '.join(CLOSED_FORMS)}, which need no training",
    )
    parser.add_argument("-o", "--output", metavar="FOLDER", help="made if missing (default: evaluation, beside it)")
    add_psfs_option(parser, ", which takes the captures")
    add_noise_option(parser, "that of the training")
    parser.add_argument(
        "--scenes", type=int, metavar="N", help="number (default: the whole test split; 32 of generated scenes)"
    )
    parser.add_argument("--pictures", type=int, default=8, metavar="N", help="scenes drawn (default: 8)")
    parser.add_argument("--noise-seed", type=seed, default=0, metavar="N", help="of the sensor (default: 0)")
    add_scene_options(
        parser.add_argument_group(
            "scenes",
            "Defaults are those of the training. They are the data's own for testing: a tenth of\n"
            "an rgbd-folder that was trained on, and all of another.",
        )
    )


def run(args: argparse.Namespace) -> None:
    """Evaluate the system, write results and pictures, and print a summary."""
    folder = Path(args.output) if args.output else Path(args.checkpoint).parent / "evaluation"
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"cannot write into {folder}: it is not a folder")
    sensor, _ = read_noise(args.noise)
    system = load_system(args.checkpoint, args.psfs, sensor)
    trained = TrainingSettings.of(system)
    settings = trained.replace(**{name: value for name, value in given_settings(args).items() if name != "scenes"})
    if settings.data != trained.data and "root" not in args:
        settings = settings.replace(root=None)  # the stored folder belongs to the other data set
    seen = (settings.data, _place(settings.root)) == (trained.data, _place(trained.root))
    split = "test" if seen or settings.data != "rgbd-folder" else "all"
    scenes = make_scenes(settings, split, args.scenes)
    tell("system", f"{settings.task}, {settings.masks} masks, head {settings.head!r}, {system.step} steps")
    folder.mkdir(parents=True, exist_ok=True)
    numbers = count()
    with tqdm(desc="evaluate", file=sys.stderr, leave=False, unit="scene", disable=None) as progress:

        def each(result: SceneResult) -> None:
            if next(numbers) < args.pictures:
                draw_scene(folder, result)
            progress.update()

        rows = evaluate(system, scenes, args.noise_seed, each)
    about = {"checkpoint": str(args.checkpoint), "step": system.step, "noise_seed": args.noise_seed, "split": split}
    about |= {"psfs": args.psfs, "noise": args.noise}
    near, far = metric_range(settings.camera())
    write_table(folder, rows, {**about, "metres_counted": [near, far], "settings": settings.as_dict()})
    for line in table(rows):
        print(line)
    if "depth" in MAPS[settings.task]:
        tell("metres", f"pixels count whose depth is known, from {near:.4g} to {far:.4g} m")
    tell("wrote", f"{folder / 'results.csv'}, {len(rows)} scenes")
    tell("", str(folder / "summary.json"))


def _place(root: str | None) -> Path | None:
    return None if root is None else Path(root).resolve()
