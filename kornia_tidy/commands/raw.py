"""`kornia-tidy raw`: camera raw files, each thing that can be done with them in a file of its own."""

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
Camera raw files: the counts of a sensor, before any camera has made a picture of
them. FILES are what cameras write (DNG, CR2, CR3, NEF, ARW, RAF, ORF, RW2, ...) or
bare dumps of counts, whose size and levels you then give. Each file is decoded in
a process of its own with limits of time and memory, so that a damaged one costs
one sentence and never hides the others.
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
