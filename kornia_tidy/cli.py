"""The `kornia-tidy` command with its subcommands, exit statuses and error messages of one sentence."""

from __future__ import annotations

import argparse
import io
import os
import signal
import sys
import threading
import traceback
import warnings
from collections.abc import Generator, Sequence
from contextlib import contextmanager, suppress
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

# Exit statuses; 70 is EX_SOFTWARE of sysexits.h, those above 128 are 128 and the number of the signal.
DONE, CANNOT, BUG, INTERRUPTED, NOBODY_READS, TERMINATED = 0, 2, 70, 130, 141, 143
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
    _print_any_name()
    args = build_parser().parse_args(argv)
    with warnings.catch_warnings(), _termination_raised():
        warnings.showwarning = _print_warning  # ty: ignore[invalid-assignment]
        try:
            args.run(args)
            sys.stdout.flush()  # raises here if the disk is full or the pipe is closed
        except KeyboardInterrupt as stop:
            return _stopped(stop)
        except BrokenPipeError:
            _forget_stdout()
            return NOBODY_READS
        except Exception as error:
            stop = _interruption_behind(error)
            return _told(error) if stop is None else _stopped(stop)
    return DONE


def _stopped(stop: KeyboardInterrupt) -> int:
    """Say that a signal ended the command; return its exit status."""
    terminated = isinstance(stop, _Terminated)
    print(f"kornia-tidy: {'terminated' if terminated else 'interrupted'}", file=sys.stderr)
    return TERMINATED if terminated else INTERRUPTED


def _interruption_behind(error: BaseException | None) -> KeyboardInterrupt | None:
    """Return the signal that an error comes from: in the middle of an import it may be told as an ``ImportError``."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error


def _print_any_name() -> None:
    """Let standard output escape file names that are not UTF-8, as standard error does, instead of failing on them."""
    if isinstance(sys.stdout, io.TextIOWrapper) and sys.stdout.errors == "strict":
        sys.stdout.reconfigure(errors="backslashreplace")


class _Terminated(KeyboardInterrupt):
    """SIGTERM, raised as Ctrl-C is, so that temporary files are removed and locks released."""


@contextmanager
def _termination_raised() -> Generator[None]:
    """Raise :class:`_Terminated` on SIGTERM within a block, in the main thread and where nobody handles it."""

    def end(*_: object) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # a second one would interrupt the clearing up
        raise _Terminated

    in_main_thread = threading.current_thread() is threading.main_thread()
    if not in_main_thread or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield
        return
    signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


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
