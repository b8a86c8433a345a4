"""The `kornia-tidy` command with its subcommands, exit statuses and error messages of one sentence."""

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
from kornia_tidy.app import command as app
from kornia_tidy.commands import (
    demo,
    design,
    evaluate,
    info,
    masks,
    psf,
    raw,
    render,
    simulate,
    systems,
    trade,
    train,
    tune,
)

# Each has add_parser(subparsers), which sets run(args).
COMMANDS = (simulate, demo, design, systems, psf, masks, raw, train, evaluate, render, trade, tune, app, info)

DONE, CANNOT, BUG, INTERRUPTED, NOBODY_READS = 0, 2, 70, 130, 141  # exit statuses; 70 is EX_SOFTWARE of sysexits.h
DEBUG = "KORNIA_TIDY_DEBUG"  # environment variable; if set, tracebacks are printed

DESCRIPTION = """\
A programmable camera: a phase mask in its lens changes while the shutter is open, so that each depth of the scene
leaves its own, time-averaged pattern in the picture.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: the arguments. Default: those of the process.

    Returns:
        Exit status: 0 after success, 2 for a mistake of the user or of a file, 70 for a fault of the library, 130 if
        interrupted, 141 if the reader of the output has closed its pipe.

    Raises:
        SystemExit: from argparse, after ``--help`` (0) or arguments that it cannot read (2).
    """
    args = build_parser().parse_args(argv)
    with warnings.catch_warnings():
        warnings.showwarning = _print_warning  # ty: ignore[invalid-assignment]
        try:
            args.run(args)
            sys.stdout.flush()  # raises here if the disk is full or the pipe is closed
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
    """Print an error as one sentence, and return the exit status."""
    if os.environ.get(DEBUG):
        traceback.print_exception(error)
    if _is_out_of_memory(error):
        print(f"kornia-tidy: error: out of memory: {_sentence(error)}", file=sys.stderr)
        return CANNOT
    if isinstance(error, (ImportError, KeyError, OSError, TypeError, ValueError)):
        print(f"kornia-tidy: error: {_sentence(error)}", file=sys.stderr)
        return CANNOT
    print(
        f"kornia-tidy: error: this is a fault of kornia-tidy, not yours ({type(error).__name__}: {_sentence(error)}); "
        f"please report it with the output of the same command with {DEBUG}=1 in the environment",
        file=sys.stderr,
    )
    return BUG


def _is_out_of_memory(error: Exception) -> bool:
    """Return whether an error means exhausted memory, also for generic errors of PyTorch and OpenCV on the CPU."""
    if isinstance(error, (MemoryError, torch.OutOfMemoryError)):
        return True
    text = str(error)
    return (isinstance(error, RuntimeError) and "allocate memory" in text) or "Insufficient memory" in text


def _forget_stdout() -> None:
    """Redirect standard output to the null device, so that the interpreter's final flush does not fail again."""
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
    """Return an error's message in one line, without the quotes of ``str(KeyError)``."""
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
