"""The `kornia-tidy` command: the library from a shell, one sentence for every mistake."""

from __future__ import annotations

import argparse
import sys
import warnings
from collections.abc import Sequence
from typing import TextIO

import kornia_tidy
from kornia_tidy.commands import demo, evaluate, info, masks, raw, render, simulate, systems, trade, train

# Each has add_parser(subparsers), which sets run(args).
COMMANDS = (simulate, demo, systems, masks, raw, train, evaluate, render, trade, info)

DESCRIPTION = """\
A programmable camera: a phase mask in its lens changes while the shutter is open, so that each depth of the scene
leaves its own, time-averaged pattern in the picture.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: the arguments. Default: those of the process.

    Returns:
        Exit status: 0 if all went well, 2 if what was asked for cannot be done, 130 if interrupted.

    Raises:
        SystemExit: from argparse, after ``--help`` (0) or arguments that it cannot read (2).
    """
    args = build_parser().parse_args(argv)
    with warnings.catch_warnings():
        warnings.showwarning = _print_warning  # ty: ignore[invalid-assignment]
        try:
            args.run(args)
        except KeyboardInterrupt:
            print("kornia-tidy: interrupted", file=sys.stderr)
            return 130
        except (ImportError, KeyError, OSError, TypeError, ValueError) as error:
            print(f"kornia-tidy: error: {_sentence(error)}", file=sys.stderr)
            return 2
    return 0


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the command and all its subcommands."""
    parser = argparse.ArgumentParser(prog="kornia-tidy", description=DESCRIPTION)
    parser.add_argument("--version", action="version", version=f"kornia-tidy {kornia_tidy.__version__}")
    subparsers = parser.add_subparsers(required=True, metavar="COMMAND", title="commands")
    for command in COMMANDS:
        command.add_parser(subparsers)
    return parser


def _sentence(error: BaseException) -> str:
    """Return an error's message in one line; str(KeyError) would put it in quotes."""
    text = str(error.args[0]) if isinstance(error, KeyError) and error.args else str(error)
    return " ".join(text.split()) or type(error).__name__


def _print_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    print(f"kornia-tidy: warning: {' '.join(str(message).split())}", file=sys.stderr)


if __name__ == "__main__":
    sys.exit(main())
