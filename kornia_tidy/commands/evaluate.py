"""`kornia-tidy evaluate`: how well a trained system does, scene by scene."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from tqdm import tqdm

from kornia_tidy.commands.options import seed
from kornia_tidy.commands.report import tell
from kornia_tidy.commands.train import add_scene_options, given_settings
from kornia_tidy.training.evaluation import Looked, draw_scene, evaluate, mean_row, write_table
from kornia_tidy.training.scenes import make_scenes
from kornia_tidy.training.trained import load_trained

DESCRIPTION = """\
Let a trained camera and network see scenes they were not trained on. FOLDER gets
results.csv (a line a scene), summary.json (means and settings), and of the first scenes
the capture, the estimates, the truths and the errors times 3, as pictures.

Errors are root mean squares: of images in [0, 1], and of depth as it is learnt, 0 at the
far and 1 at the near end of the camera's range, linear in inverse depth.
"""


def add_parser(subparsers: Any) -> None:
    """Describe the command to argparse."""
    parser = subparsers.add_parser(
        "evaluate",
        help="how well a trained system does",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)
    parser.add_argument("checkpoint", metavar="CHECKPOINT", help="best.safetensors or last.safetensors of a run")
    parser.add_argument("-o", "--output", metavar="FOLDER", help="made if missing (default: evaluation, beside it)")
    parser.add_argument("--scenes", type=int, default=32, metavar="N", help="number, of scenes made here (default: 32)")
    parser.add_argument("--pictures", type=int, default=8, metavar="N", help="scenes drawn (default: 8)")
    parser.add_argument("--noise-seed", type=seed, default=0, metavar="N", help="of the sensor (default: 0)")
    add_scene_options(parser.add_argument_group("scenes", "Defaults are those of the training."))


def run(args: argparse.Namespace) -> None:
    """Evaluate, write and tell."""
    folder = Path(args.output) if args.output else Path(args.checkpoint).parent / "evaluation"
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"cannot write into {folder}: it is not a folder")
    system = load_trained(args.checkpoint)
    given = {name: value for name, value in given_settings(args).items() if name != "scenes"}
    settings = system.settings.replace(**given, validation_scenes=args.scenes)
    scenes = make_scenes(settings, "test")
    tell("system", f"{settings.task}, {settings.masks} masks, head {settings.head!r}, {system.step} steps")
    folder.mkdir(parents=True, exist_ok=True)
    with tqdm(desc="evaluate", file=sys.stderr, leave=False, unit="scene") as progress:

        def each(looked: Looked) -> None:
            if progress.n < args.pictures:
                draw_scene(folder, looked)
            progress.update()

        rows = evaluate(system, scenes, args.noise_seed, each)
    about = {"checkpoint": str(args.checkpoint), "step": system.step, "noise_seed": args.noise_seed}
    write_table(folder, rows, {**about, "settings": settings.as_dict()})
    for name, value in mean_row(rows).items():
        tell(name, f"{value:.4f}" + (" dB" if name.endswith("psnr") else ""))
    tell("wrote", f"{folder / 'results.csv'}, {len(rows)} scenes")
    tell("", str(folder / "summary.json"))
