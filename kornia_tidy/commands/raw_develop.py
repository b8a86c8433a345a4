"""`kornia-tidy raw develop`: pictures from camera raw files."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from kornia_tidy.commands.raw_options import add_dump_options, for_each_file, open_raw
from kornia_tidy.commands.report import Stages, tell
from kornia_tidy.data.image_files import write_image
from kornia_tidy.raw.capture import RawCapture
from kornia_tidy.raw.color import ADAPTATIONS, ASSUMED_CAMERA
from kornia_tidy.raw.demosaic import METHODS
from kornia_tidy.raw.develop import (
    HIGHLIGHTS,
    WHITE_BALANCES,
    balance_factors,
    default_method,
    develop,
    encode,
    matrix_origin,
)

DESCRIPTION = """\
Develop raw files into pictures: black and white levels, white balance, demosaicing,
colour conversion to sRGB, upright orientation and square pixels. Nothing is
brightened, sharpened or denoised. Each FILE becomes FOLDER/FILE.png, 16 bits, and a
preview FOLDER/FILE.jpg. Files are written atomically.
"""

EXAMPLES = """\
examples:
  All files of a folder; if interrupted, go on with --resume:
    kornia-tidy raw develop shots/*.dng -o pictures

  For measurements: linear light on the pixel grid of the sensor, without interpolation:
    kornia-tidy raw develop shots/*.dng -o planes --demosaic half --linear --sensor-grid

  Files without a white balance, which look green or orange:
    kornia-tidy raw develop quicktake/*.qtk -o pictures --white-balance auto

  A headerless dump of counts, with factors for red, green and blue:
    kornia-tidy raw develop dump.raw --size 768x512 --pattern RGGB --black 600 --white 15520 \\
        --white-balance 1.9 1 1.5 -o pictures

The first one in Python:
  from kornia_tidy.data.image_files import write_image
  from kornia_tidy.raw.capture import RawCapture
  write_image("pictures/shot.png", develop(RawCapture.open("shots/shot.dng")), bits=16)

Exit status 2 if any file failed; the others are developed all the same.
"""

SUFFIXES = {"png": ".png", "tiff": ".tif"}


def add_parser(subparsers: Any) -> None:
    """Describe the subcommand to argparse."""
    parser = subparsers.add_parser(
        "develop",
        help="make pictures of raw files",
        description=DESCRIPTION,
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(run=run)
    parser.add_argument("files", nargs="+", metavar="FILES", help="camera raw files")
    parser.add_argument("-o", "--output", required=True, metavar="FOLDER", help="where to; made if it is not there")
    parser.add_argument("--format", choices=tuple(SUFFIXES), default="png", help="of the 16-bit picture (default: png)")
    parser.add_argument("--no-preview", action="store_true", help="no JPEG beside it")
    parser.add_argument("--resume", action="store_true", help="keep pictures that are there, develop the others")

    look = parser.add_argument_group("developing")
    look.add_argument(
        "--demosaic",
        choices=METHODS,
        metavar="METHOD",
        help=f"{', '.join(METHODS)} (default: LibRaw's AHD for Bayer, Markesteijn's for X-Trans, else bilinear)",
    )
    add_white_balance_option(look)
    look.add_argument(
        "--highlights",
        choices=HIGHLIGHTS,
        default="clip",
        help="clip all channels where the first saturates, or keep what others saw above (default: clip)",
    )
    look.add_argument(
        "--adaptation",
        choices=ADAPTATIONS,
        help="chromatic adaptation of eyes (default: none but the white balance, as LibRaw)",
    )
    look.add_argument("--linear", action="store_true", help="linear light in the 16-bit picture, not encoded as sRGB")
    look.add_argument(
        "--sensor-grid", action="store_true", help="pixels as on the sensor: neither turned nor stretched"
    )
    add_dump_options(parser)


def run(args: argparse.Namespace) -> None:
    """Develop raw files."""
    white_balance = parse_white_balance(args.white_balance)
    folder = Path(args.output)
    suffixes = [SUFFIXES[args.format], *([] if args.no_preview else [".jpg"])]
    outputs = output_paths(args.files, folder, suffixes)
    folder.mkdir(parents=True, exist_ok=True)
    done = {"developed": 0, "kept": 0}
    stages = Stages()

    def work(path: str) -> None:
        place = f"{list(outputs).index(path) + 1}/{len(outputs)}"
        paths = outputs[path]
        if args.resume and all(output.exists() for output in paths):
            done["kept"] += 1
            tell(place, f"{path}: kept {paths[0]}")
            return
        with stages("decode"):
            raw = open_raw(path, args)
        with stages("develop"), torch.no_grad():
            image = develop(
                raw,
                args.demosaic,
                white_balance=white_balance,
                highlights=args.highlights,
                adaptation=args.adaptation,
                encoded=False,
                square_pixels=not args.sensor_grid,
                upright=not args.sensor_grid,
            )
            clipped = clipped_in_words(image)
            encoded = encode(image.clamp_(0, 1))
        with stages("write"):
            for output in reversed(paths):  # the preview is written first, so that a picture means that both exist
                if output.suffix == ".jpg":
                    write_image(output, encoded)
                else:
                    write_image(output, image if args.linear else encoded, bits=16)
        done["developed"] += 1
        tell(place, f"{path}: {image.shape[-1]} x {image.shape[-2]} px, {colors_in_words(raw, args, white_balance)}")
        tell("", f"{clipped}; wrote {paths[0]}")

    try:
        for_each_file(list(outputs), work)
    finally:
        missing = len(outputs) - sum(done.values())
        tell("files", f"{done['developed']} developed, {done['kept']} kept, {missing} failed or left")
        tell("time", stages.summary())


def output_paths(files: Sequence[str], folder: Path, suffixes: Sequence[str]) -> dict[str, list[Path]]:
    """Return the output paths of each file.

    Raises:
        ValueError: if two files would become the same picture, or a picture would replace one of the files.
    """
    outputs: dict[str, list[Path]] = {}
    owners: dict[str, str] = {}
    for path in dict.fromkeys(files):
        stem = Path(path).stem
        if stem in owners:
            raise ValueError(f"{owners[stem]} and {path} would both become {folder / stem}{suffixes[0]}")
        owners[stem] = path
        outputs[path] = [folder / f"{stem}{suffix}" for suffix in suffixes]
    taken = {Path(path).resolve() for path in files}
    for output in (output for each in outputs.values() for output in each):
        if output.resolve() in taken:
            raise ValueError(f"cannot write {output}: it is an input")
    return outputs


def add_white_balance_option(group: Any) -> None:
    """Add the option read by :func:`parse_white_balance`."""
    group.add_argument(
        "--white-balance",
        nargs="+",
        metavar="WB",
        help="as-shot, daylight, auto (what is bright is grey on average), none, or a factor for each colour "
        "(default: as shot, else daylight, else none)",
    )


def parse_white_balance(words: Sequence[str] | None) -> str | Tensor | None:
    """Return the white balance of the arguments: a name, factors, or None for the default.

    Example:
        >>> parse_white_balance(["as-shot"]), parse_white_balance(["2", "1", "1.5"])
        ('as shot', tensor([2.0000, 1.0000, 1.5000]))
    """
    if words is None:
        return None
    if len(words) == 1 and words[0].replace("-", " ") in WHITE_BALANCES:
        return words[0].replace("-", " ")
    try:
        return torch.tensor([float(word) for word in words])
    except ValueError:
        names = ", ".join(name.replace(" ", "-") for name in WHITE_BALANCES)
        raise ValueError(f"--white-balance is {names}, or factors, got {' '.join(words)}") from None


def colors_in_words(raw: RawCapture, args: argparse.Namespace, white_balance: str | Tensor | None) -> str:
    """Describe the colour matrix and the white balance of a picture."""
    if not raw.colors:
        return "monochrome"
    factors = balance_factors(raw, white_balance)
    balance = " ".join(f"{name} {factor:.4g}" for name, factor in zip(raw.colors, factors.tolist(), strict=True))
    method = "no filter array" if raw.pattern is None else args.demosaic or default_method(raw)
    matrix = {
        "file": "the file's matrix",
        "model": "LibRaw's matrix of the camera",
        "assumed": f"no matrix: that of {ASSUMED_CAMERA} is assumed",
    }[matrix_origin(raw)]
    return f"{method}, white balance {balance}, {matrix}"


def clipped_in_words(image: Tensor) -> str:
    """Describe the share of a linear picture that a file of [0, 1] clips.

    Example:
        >>> clipped_in_words(torch.tensor([[[-0.1, 0.5, 1.0, 1.2]]]))
        '25 % of its values lie above white and 25 % below black, and are clipped'
    """
    above, below = (100 * float(share.float().mean()) for share in (image > 1, image < 0))
    return f"{above:.3g} % of its values lie above white and {below:.3g} % below black, and are clipped"
