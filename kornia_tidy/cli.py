"""The `kornia-tidy` command: the library from a shell, one sentence for every mistake."""

from __future__ import annotations

import argparse
import os
import sys
import traceback
import warnings
from collections.abc import Sequence
from contextlib import suppress
from typing import TextIO

import torch

import kornia_tidy
from kornia_tidy.commands import demo, evaluate, info, masks, psf, raw, render, simulate, systems, trade, train, tune

# Each has add_parser(subparsers), which sets run(args).
COMMANDS = (simulate, demo, systems, psf, masks, raw, train, evaluate, render, trade, tune, info)

DONE, CANNOT, BUG, INTERRUPTED, NOBODY_READS = 0, 2, 70, 130, 141  # exit statuses; 70 is EX_SOFTWARE of sysexits.h
DEBUG = "KORNIA_TIDY_DEBUG"  # in the environment, set to anything: tracebacks too

DESCRIPTION = """\
A programmable camera: a phase mask in its lens changes while the shutter is open, so that each depth of the scene
leaves its own, time-averaged pattern in the picture.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: the arguments. Default: those of the process.

    Returns:
        Exit status: 0 if all went well, 2 if what was asked for cannot be done, 70 if the library is at fault, 130 if
        interrupted, 141 if nobody reads any more what it prints.

    Raises:
        SystemExit: from argparse, after ``--help`` (0) or arguments that it cannot read (2).
    """
    args = build_parser().parse_args(argv)
    with warnings.catch_warnings():
        warnings.showwarning = _print_warning  # ty: ignore[invalid-assignment]
        try:
            args.run(args)
            sys.stdout.flush()  # here, where a full disk or a closed pipe can be told of
        except KeyboardInterrupt:
            print("kornia-tidy: interrupted", file=sys.stderr)
            return INTERRUPTED
        except BrokenPipeError:
            _forget_stdout()
            return NOBODY_READS
        except Exception as error:
            return _told(error)
    return DONE


def _told(error: Exception) -> int:
    """Say in one sentence what went wrong; return the exit status."""
    if os.environ.get(DEBUG):
        traceback.print_exception(error)
    if _is_out_of_memory(error):
        print(f"kornia-tidy: error: the memory that this needs is not there: {_sentence(error)}", file=sys.stderr)
        return CANNOT
    if isinstance(error, (ImportError, KeyError, OSError, TypeError, ValueError)):
        print(f"kornia-tidy: error: {_sentence(error)}", file=sys.stderr)
        return CANNOT
    print(
        f"kornia-tidy: error: this is a fault of kornia-tidy, not yours ({type(error).__name__}: {_sentence(error)}); "
        f"please report it with what {DEBUG}=1 in the environment prints",
        file=sys.stderr,
    )
    return BUG


def _is_out_of_memory(error: Exception) -> bool:
    """PyTorch's and OpenCV's allocators raise errors of no kind of their own on the CPU."""
    if isinstance(error, (MemoryError, torch.OutOfMemoryError)):
        return True
    text = str(error)
    return (isinstance(error, RuntimeError) and "allocate memory" in text) or "Insufficient memory" in text


def _forget_stdout() -> None:
    """Let the interpreter end without trying once more to print what nobody reads."""
    with suppress(OSError, ValueError):
        nothing = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nothing, sys.stdout.fileno())
        os.close(nothing)


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
