"""`kornia-tidy design`: co-design of aperture, focus and masks, and whether masks pay."""

from __future__ import annotations

import argparse
import math
import sys
import time
from io import BytesIO
from pathlib import Path
from typing import Any

from torch import nn
from tqdm import tqdm

from kornia_tidy.commands.options import mask_count, seed
from kornia_tidy.commands.report import tell
from kornia_tidy.data.patches import central_crop
from kornia_tidy.data.rgbd import Scene
from kornia_tidy.data.rgbd_folder import described_folder
from kornia_tidy.figures.co_design import draw_co_design
from kornia_tidy.figures.style import require_matplotlib
from kornia_tidy.files import only_here, write_bytes
from kornia_tidy.mask_design.candidates import coded_candidate, flat_candidate
from kornia_tidy.mask_design.co_design import CoDesign, Effort, co_design, planned_work
from kornia_tidy.mask_design.design_report import (
    CAMERA,
    DATA,
    PICTURE,
    REPORT,
    design_files,
    exposure_in_words,
    focus_distance,
)
from kornia_tidy.mask_design.design_task import DesignTask
from kornia_tidy.mask_design.simulated_captures import leaf_scenes, score_candidate
from kornia_tidy.modulator.modulator import DwellTimes, SpatialLightModulator
from kornia_tidy.modulator.phase_panel import GreyLevels
from kornia_tidy.modulator.switching import BETWEEN, Switching

DESCRIPTION = """\
Design aperture, focus and phase masks of a camera together, for extended depth of field,
for depth, or for both; and tell whether the masks pay. A wide aperture with masks gets
more light, a lens that is stopped down is sharper over a larger range of depths: which of
the two is ahead depends on the light and on the range of depths.

Everything is compared at the same exposure time: light is given as the electrons of a
white pixel at one f-number, and falls with the square of the f-number. Where white would
exceed the full well of a pixel the exposure is shorter.

  search    flat lenses and masks at f-numbers one stop apart, by the error of the best linear
            restoration (and of depth by texture); masks start from a
            focal sweep, a Fisher mask and noise, and see the modulator's switching and
            grey levels
  captures  the best of both take pictures of scenes (dead leaves, and yours), which the
            best closed form restores; settings are chosen on one half of the scenes,
            scores are from the other
Masks are recommended only if they are ahead by more than two standard errors.
"""

EPILOG = """\
FOLDER gets report.md (read this first), design.png, report.json, masks.npy (heights of
the best masks in metres) and camera.safetensors (the recommended camera):
  kornia-tidy masks export FOLDER/camera.safetensors -o slm      frames for a modulator
  kornia-tidy psf FOLDER/camera.safetensors --aperture-diameter A --focus-distance Z
its PSFs, with the aperture and the focus that are printed at the end.
After Ctrl-C the same command goes on where it stopped (FOLDER/progress.json).

How many electrons? The full well of the pixel if white nearly saturates it. Else roughly
  500 * illuminance in lux * exposure in seconds * (pixel pitch in um)^2 / f-number^2
at a quantum efficiency of one half: 17,000 lux (day, in the shade) for 33 ms on 8 um
pixels give 57,000 at f/17.6, and 300 lux (a room) give 1,000.

examples:
  The camera of the paper in bright light, a first answer:
    kornia-tidy design --quick
  A range of 0.5 to 4 m in dim light, with a modulator of 8 bits that takes 4 ms:
    kornia-tidy design --depth-range 0.5 4 --electrons 5000 --bits 8 \\
        --switching-time 4e-3 --exposure 33e-3 -o outputs/dim
  Image and depth count alike; your own scenes decide too:
    kornia-tidy design --depth-weight 0.5 --scenes my/scenes -o outputs/both
"""

PROGRESS = "progress.json"
DOTS_PER_INCH = 150
_LARGEST = 512  # pixels a side of the user's scenes; of larger ones the middle


def add_parser(subparsers: Any) -> None:
    """Describe the command to argparse."""
    parser = subparsers.add_parser(
        "design",
        help="design aperture and masks together; do masks pay?",
        description=DESCRIPTION,
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)
    parser.add_argument(
        "-o", "--output", default="outputs/design", metavar="FOLDER", help="made if missing (default: outputs/design)"
    )
    parser.add_argument(
        "--quick", action="store_true", help="fewer steps and scenes: a first answer, in 20 s on one core"
    )
    parser.add_argument("--seed", type=seed, default=0, metavar="N", help="of all that is random (default: 0)")

    default = DesignTask()
    scene = parser.add_argument_group("scene and what matters")
    scene.add_argument(
        "--depth-range",
        type=float,
        nargs=2,
        default=default.depth_range,
        metavar=("NEAR", "FAR"),
        help="metres; FAR may be inf (default: 0.2975 inf)",
    )
    scene.add_argument(
        "--depth-weight",
        type=float,
        default=default.depth_weight,
        metavar="W",
        help="share of depth in what matters, from 0, the image alone, to 1 (default: 0)",
    )
    scene.add_argument(
        "--scenes",
        metavar="FOLDER",
        help='pictures with depth, paired by FOLDER/rgbd.json: {"image": "*.png", "depth": "*_depth.png", "scale": '
        "0.001}; they decide beside dead leaves",
    )
    camera = parser.add_argument_group("lens and sensor")
    camera.add_argument(
        "--focal-length", type=float, default=default.focal_length, metavar="M", help="metres (default: 0.05)"
    )
    camera.add_argument(
        "--pixel-pitch", type=float, default=default.pixel_pitch, metavar="M", help="metres (default: 8e-6)"
    )
    camera.add_argument(
        "--electrons",
        type=float,
        default=default.electrons,
        metavar="N",
        help="of a white pixel at the reference f-number (default: 57000)",
    )
    camera.add_argument(
        "--reference-f-number",
        type=float,
        default=default.reference_f_number,
        metavar="F",
        help="f-number at which they are counted (default: 17.6)",
    )
    camera.add_argument(
        "--full-well",
        type=float,
        default=default.full_well_electrons,
        metavar="N",
        help="capacity of a pixel in electrons, which limits the exposure (default: by its area, 57000 at 8 um)",
    )
    camera.add_argument(
        "--read-noise",
        type=float,
        default=default.read_noise_electrons,
        metavar="N",
        help="standard deviation in electrons (default: 2.4)",
    )
    modulator = parser.add_argument_group("modulator")
    modulator.add_argument(
        "--masks", type=mask_count, default=default.masks, metavar="K", help="masks in one exposure (default: 5)"
    )
    modulator.add_argument(
        "--mask-size",
        type=int,
        default=default.mask_size,
        metavar="N",
        help="its pixels along a side, 20 of 23 of which span the aperture: more scatter less light (default: 23)",
    )
    modulator.add_argument(
        "--bits", type=int, metavar="B", help="of its grey levels over one wave (default: any phase)"
    )
    modulator.add_argument(
        "--switching-time", type=float, default=0.0, metavar="S", help="from mask to mask, seconds (default: 0)"
    )
    modulator.add_argument("--exposure", type=float, default=0.1, metavar="S", help="seconds (default: 0.1)")
    modulator.add_argument(
        "--between", choices=BETWEEN, default="exponential", help="phase while it switches (default: exponential)"
    )


def run(args: argparse.Namespace) -> None:
    """Design, and write the files."""
    folder = Path(args.output)
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"cannot write into {folder}: it is not a folder")
    require_matplotlib()
    task = make_task(args)
    effort = Effort.quick() if args.quick else Effort()
    scenes = _own_scenes(args.scenes)
    folder.mkdir(parents=True, exist_ok=True)
    with only_here(folder, "a design is running"):
        work = planned_work(task, effort, len(scenes))
        near, far = task.depth_range
        tell("scene", f"depths {near:g} to {far:g} m, {effort.scenes} dead leaves, {len(scenes)} scenes of yours")
        tell("light", f"{task.electrons:g} electrons of white at f/{task.reference_f_number:g}, equal exposure time")
        tell("work", _estimate(task, effort, work) + _earlier(folder / PROGRESS))
        design = _with_progress(task, scenes, effort, args.seed, folder / PROGRESS, work)
        _write(folder, design)
    tell("verdict", design.words)
    focus, f_number = focus_distance(task, design.recommended), design.recommended.f_number
    tell("exposure", exposure_in_words(design))
    tell("camera", f"f/{f_number:.3g}, aperture {task.focal_length / f_number:.3g} m, focus at {focus:.3g} m")
    tell("wrote", f"{folder / REPORT}: read this one")
    for name in (PICTURE, DATA, "masks.npy", CAMERA):
        tell("", str(folder / name))


def make_task(args: argparse.Namespace) -> DesignTask:
    """Return the task that the arguments describe.

    Raises:
        ValueError: if a value is out of its range, or a length not in metres.
    """
    near, far = args.depth_range
    return DesignTask(
        depth_range=(near, far),
        focal_length=args.focal_length,
        pixel_pitch=args.pixel_pitch,
        electrons=args.electrons,
        reference_f_number=args.reference_f_number,
        read_noise_electrons=args.read_noise,
        masks=args.masks,
        modulator=_modulator(args),
        depth_weight=args.depth_weight,
        mask_size=args.mask_size,
        full_well_electrons=args.full_well,
    )


def _modulator(args: argparse.Namespace) -> nn.Module:
    parts: list[nn.Module] = [] if args.bits is None else [GreyLevels(args.bits)]
    timing = Switching(args.switching_time, args.exposure, args.between) if args.switching_time else DwellTimes()
    return SpatialLightModulator(*parts, timing) if parts else timing


def _own_scenes(folder: str | None) -> list[Scene]:
    """Return the middles of the user's scenes."""
    if folder is None:
        return []
    scenes = []
    for sample in described_folder(Path(folder)):
        height, width = sample["image"].shape[-2:]
        cut = central_crop(sample, (min(height, _LARGEST), min(width, _LARGEST)))
        scenes.append(Scene(cut["image"], cut["depth"], cut["mask"]))
    return scenes


def _estimate(task: DesignTask, effort: Effort, work: dict[str, int]) -> str:
    """Return the work and its time in words, from a few steps and one capture."""
    f_number = task.f_numbers()[1]
    times = []
    for steps in (1, 3):  # the first step also computes what the others find
        start = time.perf_counter()
        coded_candidate(task, "focal sweep", f_number, 0.5, steps)
        times.append(time.perf_counter() - start)
    step = times[1] / 4
    scenes = leaf_scenes(2, effort.size, task.depth_range)
    start = time.perf_counter()
    list(score_candidate(task, flat_candidate(task, task.balanced_f_number, 0.5), scenes))
    seconds = work["search"] * step + work["captures"] * (time.perf_counter() - start) / 2
    told = f"{seconds:.0f} s" if seconds < 100 else f"{math.ceil(seconds / 60)} minutes"
    return f"{work['search']} gradient steps and {work['captures']} captures, about {told}"


def _earlier(progress_file: Path) -> str:
    return f"; {progress_file} goes on, if it is of this design" if progress_file.exists() else ""


def _with_progress(
    task: DesignTask, scenes: list[Scene], effort: Effort, number: int, progress_file: Path, work: dict[str, int]
) -> CoDesign:
    """Run the co-design with a progress bar for each stage."""
    bars: dict[str, tqdm] = {}

    def progress(stage: str, amount: int) -> None:
        if stage not in bars:
            for bar in bars.values():
                bar.close()
            bars[stage] = tqdm(total=work[stage], desc=stage, file=sys.stderr, leave=False, disable=None)
        bars[stage].update(amount)

    try:
        return co_design(task, scenes, effort, number, progress_file, progress)
    except KeyboardInterrupt:
        tell("stopped", "the same command goes on from here")
        raise
    finally:
        for bar in bars.values():
            bar.close()


def _write(folder: Path, design: CoDesign) -> None:
    picture = BytesIO()
    draw_co_design(design).savefig(picture, dpi=DOTS_PER_INCH)
    for name, data in {**design_files(design), PICTURE: picture.getvalue()}.items():
        write_bytes(folder / name, data)
