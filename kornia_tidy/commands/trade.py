"""`kornia-tidy trade`: measurement of the speed-accuracy trade-off on one's own scene and device."""

from __future__ import annotations

import argparse
import sys
from io import BytesIO
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.checks import check_choice
from kornia_tidy.commands.options import (
    add_camera_options,
    add_depth_options,
    make_camera,
    mask_count,
    read_scene,
    seed,
)
from kornia_tidy.commands.report import scene_in_words, tell
from kornia_tidy.data.dead_leaves import dead_leaves
from kornia_tidy.data.rgbd import Scene
from kornia_tidy.fidelity import PRESETS
from kornia_tidy.figures.style import require_matplotlib
from kornia_tidy.files import write_bytes
from kornia_tidy.masks.pixelwise import PixelwiseMask
from kornia_tidy.render.borders import largest_window
from kornia_tidy.tradeoff.conditions import Conditions
from kornia_tidy.tradeoff.costs import DEVICES
from kornia_tidy.tradeoff.figure import draw_trade
from kornia_tidy.tradeoff.files import TradeRun, markdown, read_json, write_csv, write_json
from kornia_tidy.tradeoff.measure import TradeRow, linear_light, missing, sweep
from kornia_tidy.tradeoff.sweep_settings import PLAN, SWEEP_VALUES, Setting, planned, sweep_settings

DESCRIPTION = """\
Measure the speed-accuracy trade-off on one scene and this machine. Each setting of the
fidelity is varied alone from a preset. The presets, and the plans for this scene within
errors of 1e-1 to 1e-6, are measured too. For each point the table has the
  error    of the noise-free capture in linear light, full scale 1, against the preset
           'reference', which is rendered once
  time     of a capture after a change of the masks (PSFs and rendering), and with
           cached PSFs; median and interquartile range
  memory   peak of the tensors of a capture
Without --image and --depth the scene is generated (dead leaves).
"""

EPILOG = """\
Results are written to FOLDER/trade.json and trade.csv after every point, and at the end a
figure to trade.png and a table to the screen. After Ctrl-C the same command continues.
Another scene, machine or version of the code starts anew.

No setting can lower the error below that of the other settings. With an exact but slow
base, --base reference, the error of each setting alone is measured.

Times are reliable on an otherwise idle machine. PyTorch uses as many threads as the
environment variable OMP_NUM_THREADS says; on a busy machine fewer can be much faster.

examples:
  kornia-tidy trade                                 all settings, on a generated scene
  kornia-tidy trade --knobs window layers --training
  kornia-tidy trade --image rgb.png --depth depth.png --depth-scale 0.001 --device cuda
"""

NEAR, FAR = 0.3, float("inf")  # m: the default camera's range
DOTS_PER_INCH = 150
KNOBS = (*SWEEP_VALUES, PLAN)


def add_parser(subparsers: Any) -> None:
    """Describe the command to argparse."""
    parser = subparsers.add_parser(
        "trade",
        help="measure speed against accuracy",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)
    parser.add_argument("--image", metavar="IMAGE", help="picture of a scene (default: dead leaves, made here)")
    parser.add_argument("--depth", metavar="DEPTH", help="its depth: PNG, TIFF, PGM, PFM, NPY, OpenEXR")
    parser.add_argument(
        "-o", "--output", default="outputs/trade", metavar="FOLDER", help="made if missing (default: outputs/trade)"
    )
    parser.add_argument("--size", type=int, default=512, metavar="PX", help="side of the scene made (default: 512)")
    parser.add_argument("--masks", type=mask_count, default=5, metavar="K", help="masks in one exposure (default: 5)")
    parser.add_argument("--seed", type=seed, default=0, metavar="N", help="seed of masks and scene (default: 0)")

    measuring = parser.add_argument_group("what is measured")
    measuring.add_argument(
        "--knobs",
        nargs="+",
        choices=KNOBS,
        default=list(KNOBS),
        metavar="KNOB",
        help=f"some of {', '.join(KNOBS)} (default: all)",
    )
    measuring.add_argument(
        "--base", choices=tuple(PRESETS), default="balanced", help="preset of the other settings (default: balanced)"
    )
    measuring.add_argument(
        "--reference",
        choices=tuple(PRESETS),
        default="reference",
        help="preset to which errors refer; 'balanced' is faster on a large scene (default: reference)",
    )
    measuring.add_argument("--training", action="store_true", help="captures with gradients to the masks too")
    measuring.add_argument("--repeats", type=int, default=5, metavar="N", help="timed runs of each (default: 5)")
    measuring.add_argument("--device", default="cpu", help="cpu, cuda or cuda:N (default: cpu)")
    add_depth_options(parser)
    add_camera_options(parser)


def run(args: argparse.Namespace) -> None:
    """Measure the sweep, write files after every row, and print the table."""
    device = _checked(args)
    folder = Path(args.output)
    scene = _scene(args)
    optics = TiDyOptics(
        PixelwiseMask(args.masks, generator=torch.Generator().manual_seed(args.seed)), make_camera(args, scene)
    ).to(device)
    image, depth = scene.image.to(device), scene.depth.to(device)
    optics.check_scene(image, depth)  # warns once: the measured captures do not warn
    name = f"dead leaves, seed {args.seed}" if args.image is None else Path(args.image).name
    conditions = Conditions.here_and_now(name, optics, image, depth, args.reference)
    settings = _settings(args, optics, image, depth)
    known, why = _known(folder / "trade.json", conditions)

    tell("scene", f"{name}, {scene_in_words(scene)}")
    tell("camera", optics.camera.extra_repr())
    tell("masks", f"{optics.masks.extra_repr()}, noise of seed {args.seed}")
    tell("machine", f"{conditions.device}, {conditions.threads} threads, PyTorch {conditions.torch}")
    todo = len(missing(settings, known, args.repeats, args.training))
    tell("settings", f"{len(settings)}, {todo} different ones to be measured{why}")
    folder.mkdir(parents=True, exist_ok=True)

    rows: list[TradeRow] = []
    steps = sweep(
        optics,
        image,
        depth,
        settings,
        repeats=args.repeats,
        training=args.training,
        reference=args.reference,
        known=known,
    )
    with tqdm(
        total=len(settings), desc="trade", file=sys.stderr, leave=False, unit="setting", disable=None
    ) as progress:
        try:
            for setting in settings:
                step = f"{setting.knob} {setting.value}"
                progress.set_postfix_str(f"reference, then {step}" if todo and not rows else step)
                rows.append(next(steps))
                _write(folder, TradeRun(conditions, (*rows, *_others(known, rows))))
                progress.update()
        except KeyboardInterrupt:
            progress.close()
            tell("stopped", f"{len(rows)} of {len(settings)} settings are written; the same command goes on from there")
            raise

    shown = TradeRun(conditions, tuple(rows))
    picture = BytesIO()
    draw_trade(shown).savefig(picture, dpi=DOTS_PER_INCH)
    write_bytes(folder / "trade.png", picture.getvalue())
    print(f"\n{markdown(rows)}\n")
    tell("bold", "no other setting is both faster and closer to the reference")
    tell("wrote", f"{folder / 'trade.png'}: look at this one")
    for other in ("trade.json", "trade.csv"):
        tell("", str(folder / other))


def _checked(args: argparse.Namespace) -> torch.device:
    """Check the arguments before any work, and return the device."""
    if (args.image is None) != (args.depth is None):
        raise ValueError("--image and --depth belong together: give both, or neither for a scene made here")
    if args.repeats < 1:
        raise ValueError(f"--repeats must be 1 or more, got {args.repeats}")
    folder = Path(args.output)
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"cannot write into {folder}: it is not a folder")
    require_matplotlib()
    check_choice("--device", args.device.partition(":")[0], DEVICES)
    if args.device.startswith("cuda") and not torch.cuda.is_available():
        raise ValueError(f"--device {args.device}: PyTorch finds no CUDA GPU here")
    try:
        return torch.device(args.device)
    except RuntimeError:
        raise ValueError(f"--device must be cpu, cuda or cuda:N, got {args.device!r}") from None


def _scene(args: argparse.Namespace) -> Scene:
    if args.image is not None:
        return read_scene(args)
    image, depth = dead_leaves(args.size, args.size, depth_range=(NEAR, FAR), seed=args.seed)
    return Scene(image, depth, torch.ones_like(depth, dtype=torch.bool))


def _settings(args: argparse.Namespace, optics: TiDyOptics, image: Tensor, depth: Tensor) -> list[Setting]:
    """Return the points of the sweep and the plans, without windows wider than the border allows."""
    widest = largest_window(optics.border, *image.shape[-2:])
    steps = sweep_settings(args.base, [knob for knob in args.knobs if knob != PLAN])
    settings = [step for step in steps if (step.fidelity.window or 1) <= widest]
    if PLAN in args.knobs:
        settings += planned(optics, linear_light(optics, image)[None], depth[None])
    return settings


def _known(path: Path, conditions: Conditions) -> tuple[tuple[TradeRow, ...], str]:
    """Return the valid rows of an earlier run, and a remark about them."""
    if not path.exists():
        return (), ""
    earlier = read_json(path)
    if earlier.conditions.same(conditions):
        return earlier.rows, f"; {path} goes on"
    return (), f"; {path} is of another scene, machine or code and will be replaced"


def _others(known: tuple[TradeRow, ...], rows: list[TradeRow]) -> list[TradeRow]:
    """Return the rows of earlier runs that these do not replace."""
    done = {(row.knob, row.value, row.fidelity) for row in rows}
    return [row for row in known if (row.knob, row.value, row.fidelity) not in done]


def _write(folder: Path, run: TradeRun) -> None:
    write_json(folder / "trade.json", run)
    write_csv(folder / "trade.csv", run.rows)
