"""`kornia-tidy raw`: the group of commands for camera raw files."""

from __future__ import annotations

import argparse
from typing import Any

from kornia_tidy.commands import (
    raw_calibrate_noise,
    raw_calibrate_psf,
    raw_develop,
    raw_info,
    raw_reconstruct,
    raw_simulate,
)

# Each has add_parser(subparsers), which sets run(args).
SUBCOMMANDS = (raw_info, raw_develop, raw_reconstruct, raw_calibrate_noise, raw_calibrate_psf, raw_simulate)

DESCRIPTION = """\
Work with camera raw files, which hold the digital counts of a sensor. FILES are raw
files of cameras (DNG, CR2, CR3, NEF, ARW, RAF, ORF, RW2, ...) or headerless dumps of
counts, with size and levels given as options. Each file is decoded in a separate
process with limits of time and memory. A damaged file gives an error message, and
the other files are still processed.
"""


def add_parser(subparsers: Any) -> None:
    """Describe the command to argparse."""
    raw = subparsers.add_parser(
        "raw",
        help="camera raw files: what they hold",
        description=DESCRIPTION,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    actions = raw.add_subparsers(required=True, metavar="ACTION", title="actions")
    for subcommand in SUBCOMMANDS:
        subcommand.add_parser(actions)
