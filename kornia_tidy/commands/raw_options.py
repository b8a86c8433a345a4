"""Shared options of the raw subcommands: headerless dumps, checks of outputs, and a loop over files."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from kornia_tidy.files import check_writable
from kornia_tidy.raw.capture import RawCapture

DUMP_OPTIONS = ("size", "pattern", "black", "white", "dtype", "byte_order")


def add_dump_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that describe a headerless dump of counts."""
    group = parser.add_argument_group(
        "bare dumps of counts",
        "A headerless file needs a description: give --size, --pattern, --black\n"
        "and --white, and all FILES are read as such dumps, row by row.",
    )
    group.add_argument("--size", type=size, metavar="WxH", help="columns x rows, such as 768x512")
    group.add_argument(
        "--pattern",
        type=str.upper,
        metavar="LETTERS",
        help="colours of the filter array's tile, by rows: RGGB, GMYC, 36 letters for X-Trans; NONE for monochrome",
    )
    group.add_argument("--black", type=float, nargs="+", metavar="N", help="count without light, one or one a place")
    group.add_argument(
        "--white", type=float, metavar="N", help="saturation count; for raw files, replaces that of the file"
    )
    group.add_argument("--dtype", choices=("uint8", "uint16"), help="of a count (default: uint16)")
    group.add_argument("--byte-order", choices=("little", "big"), help="of a count (default: little)")


def open_raw(path: str, args: argparse.Namespace) -> RawCapture:
    """Open a raw file, or the dump that the options describe.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it cannot be read, or the options do not describe a dump.
    """
    if args.size is None:
        for name in DUMP_OPTIONS:
            if name != "white" and getattr(args, name) is not None:
                raise ValueError(f"--{name.replace('_', '-')} is for bare dumps of counts: give --size too")
        return RawCapture.open(path, white=args.white)
    for name in ("pattern", "black", "white"):
        if getattr(args, name) is None:
            raise ValueError(f"a bare dump of counts needs --{name}")
    return RawCapture.open_dump(
        path,
        args.size,
        None if args.pattern == "NONE" else args.pattern,
        args.black,
        args.white,
        args.dtype or "uint16",
        args.byte_order or "little",
    )


def check_outputs(outputs: Sequence[str | Path | None], inputs: Sequence[str | Path | None]) -> None:
    """Check before any work that outputs can be written and do not replace inputs; None is skipped.

    Raises:
        FileNotFoundError: if a folder does not exist.
        ValueError: if an output is a folder or an input.
    """
    there = [Path(other) for other in inputs if other is not None and Path(other).exists()]
    for path in (Path(output) for output in outputs if output is not None):
        check_writable(path)
        if path.exists() and any(path.samefile(other) for other in there):
            raise ValueError(f"cannot write {path}: it is an input")


def for_each_file(paths: Sequence[str], work: Callable[[str], None]) -> None:
    """Apply an action to every file, and go on after errors.

    Raises:
        OSError, ValueError: the error of a single file; for several files the number that failed, after their errors
            have been printed.
    """
    failed = 0
    for path in paths:
        try:
            work(path)
        except (OSError, ValueError) as error:
            if len(paths) == 1:
                raise
            failed += 1
            print(f"kornia-tidy: error: {' '.join(str(error).split())}", file=sys.stderr, flush=True)
    if failed:
        raise ValueError(f"{failed} of {len(paths)} files failed")


def size(text: str) -> tuple[int, int]:
    """Return rows and columns of WIDTHxHEIGHT."""
    match = re.fullmatch(r"([1-9]\d{0,4})x([1-9]\d{0,4})", text)
    if match is None:
        raise argparse.ArgumentTypeError(f"a size is WIDTHxHEIGHT in pixels, such as 768x512, got {text!r}")
    return int(match[2]), int(match[1])
