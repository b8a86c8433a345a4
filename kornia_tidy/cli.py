"""The `kornia-tidy` command with its subcommands, exit statuses and error messages of one sentence."""

from __future__ import annotations

import argparse
import io
import os
import signal
import sys
import traceback
import warnings
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, TextIO

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
)
from kornia_tidy.runtime.signals import Stopped, ignore_interruption, raised_signals, status_and_sentence

# Each has add_parser(subparsers), which sets run(args).
COMMANDS = (simulate, demo, design, systems, psf, masks, raw, train, evaluate, render, trade, app, info)

# Exit statuses; 70 is EX_SOFTWARE of sysexits.h, 141 is 128 and the number of SIGPIPE.
DONE, CANNOT, BUG, NOBODY_READS = 0, 2, 70, 141
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
        interrupted, 141 if the reader of the output has closed its pipe, 143 if terminated.

    Raises:
        SystemExit: from argparse, after ``--help`` (0) or arguments that it cannot read (2).
    """
    _open_closed_streams()
    _print_any_name()
    try:
        with warnings.catch_warnings(), raised_signals():
            warnings.showwarning = _print_warning  # ty: ignore[invalid-assignment]
            return _run(argv)
    finally:
        for stream in (sys.stdout, sys.stderr):
            _empty(stream)
        if argv is None:
            ignore_interruption()


def _run(argv: Sequence[str] | None) -> int:
    """Run the command line; return its exit status."""
    try:
        try:
            args = build_parser().parse_args(argv)
            args.run(args)
        except SystemExit:
            sys.stdout.flush()  # of --help
            raise
        sys.stdout.flush()  # raises here if the disk is full or the pipe is closed
    except KeyboardInterrupt as stop:
        status, sentence = status_and_sentence(stop.number if isinstance(stop, Stopped) else signal.SIGINT)
        _say(sentence)
        return status
    except BrokenPipeError:
        return NOBODY_READS
    except Exception as error:
        return _told(error)
    return DONE


def _say(sentence: str) -> None:
    """Print a line to standard error, if it can be written to."""
    with suppress(OSError):
        print(sentence, file=sys.stderr, flush=True)


def _open_closed_streams() -> None:
    """Open standard streams that are closed as the null device.

    Otherwise the next file would get their number, and with it what C libraries and child processes print.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            stream = open(os.devnull, mode, encoding="utf-8")  # noqa: SIM115 as long as the process lives
            os.set_inheritable(stream.fileno(), True)
            setattr(sys, name, stream)


def _empty(stream: TextIO) -> None:
    """Write what a stream holds, or drop it: Python would complain of it at the end and change the exit status."""
    try:
        stream.flush()
    except (OSError, ValueError):
        with suppress(OSError, ValueError):
            nothing = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nothing, stream.fileno())
            os.close(nothing)


def _print_any_name() -> None:
    """Let standard output escape file names that are not UTF-8, as standard error does, instead of failing on them."""
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors="backslashreplace")


def _told(error: Exception) -> int:
    """Print an error as one sentence, and return the exit status."""
    if os.environ.get(DEBUG):
        traceback.print_exception(error)
    if _is_out_of_memory(error):
        _say(f"kornia-tidy: error: out of memory: {_sentence(error)}")
        return CANNOT
    if isinstance(error, (ImportError, KeyError, OSError, TypeError, ValueError)):
        _say(f"kornia-tidy: error: {_sentence(error)}")
        return CANNOT
    _say(
        f"kornia-tidy: error: this is a fault of kornia-tidy, not yours ({type(error).__name__}: {_sentence(error)}); "
        f"please report it with the output of the same command with {DEBUG}=1 in the environment"
    )
    return BUG


def _is_out_of_memory(error: Exception) -> bool:
    """Return whether an error means exhausted memory, also for generic errors of PyTorch and OpenCV on the CPU."""
    if isinstance(error, (MemoryError, torch.OutOfMemoryError)):
        return True
    text = str(error)
    return (isinstance(error, RuntimeError) and "allocate memory" in text) or "Insufficient memory" in text


class _Parser(argparse.ArgumentParser):
    """A parser whose help does not vanish without a word where nothing can be written."""

    def _print_message(self, message: str, file: Any = None) -> None:
        if message:
            (file or sys.stderr).write(message)


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the command and all its subcommands."""
    parser = _Parser(prog="kornia-tidy", description=DESCRIPTION)
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
    _say(f"kornia-tidy: warning: {' '.join(str(message).split())}")


if __name__ == "__main__":
    sys.exit(main())
