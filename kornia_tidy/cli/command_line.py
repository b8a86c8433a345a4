"""The `kornia-tidy` command with its subcommands, exit statuses and error messages of one sentence."""

from __future__ import annotations

import io
import os
import signal
import sys
import traceback
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from difflib import get_close_matches
from importlib import import_module
from typing import Any, TextIO

import kornia_tidy
from kornia_tidy.cli.commands.parser import Parser, read
from kornia_tidy.settings import documented
from kornia_tidy.signals import Stopped, ignore_interruption, raised_signals, status_and_sentence

Commands = Mapping[str, "str | Commands"]

COMMANDS: Commands = {
    "simulate": "commands.simulate:Simulate",
    "demo": "commands.demo:Demo",
    "design": "commands.design:Design",
    "systems": "commands.systems:Systems",
    "psf": "commands.psf:Psf",
    "masks": {
        "show": "commands.masks:ShowMasks",
        "export": "commands.masks:ExportMasks",
        "import": "commands.masks:ImportMasks",
    },
    "raw": {
        "info": "commands.raw_info:InfoOfRaw",
        "develop": "commands.raw_develop:DevelopRaw",
        "reconstruct": "commands.raw_reconstruct:ReconstructRaw",
        "calibrate-noise": "commands.raw_calibrate_noise:CalibrateNoise",
        "calibrate-psf": "commands.raw_calibrate_psf:CalibratePsf",
        "simulate": "commands.raw_simulate:SimulateRaw",
    },
    "train": "commands.train:Train",
    "evaluate": "commands.evaluate:Evaluate",
    "render": "commands.render:Render",
    "trade": "commands.trade:Trade",
    "app": "app.command:App",
    "info": "commands.info:Info",
}
"""Commands by name: module and class, or the commands of a group."""
ABOUT = {
    "masks": "Turn masks into SLM frames or heights, and frames back into masks.",
    "raw": "Camera raw files: contents, pictures, calibrations, reconstructions.",
}
"""What the groups do."""

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
        SystemExit: from argparse, after ``--help``.
    """
    _open_closed_streams()
    _print_any_name()
    try:
        with warnings.catch_warnings():
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
            command = read_command(sys.argv[1:] if argv is None else argv)
            import_module("kornia_tidy.camera.tidy_optics")  # seconds, in which a signal ends the process at once
            with raised_signals():
                command.run()
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
    """Write the buffer of a stream, or drop it: Python would complain of it at the end and change the exit status."""
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
    torch = sys.modules.get("torch")
    if isinstance(error, MemoryError) or (torch is not None and isinstance(error, torch.OutOfMemoryError)):
        return True
    text = str(error)
    return (isinstance(error, RuntimeError) and "allocate memory" in text) or "Insufficient memory" in text


def read_command(argv: Sequence[str]) -> Any:
    """Return the command that the arguments ask for, with its settings.

    Raises:
        SystemExit: after ``--help``.
        ValueError: if an argument cannot be read, or a value is not allowed.
    """
    commands, prog, words = COMMANDS, "kornia-tidy", list(argv)
    while True:
        name = words[0] if words else ""
        if name not in commands:
            parser = _overview(commands, prog)
            if name and not name.startswith("-"):
                groups = [group for group, inner in commands.items() if isinstance(inner, dict) and name in inner]
                meant = [f"{group} {name}" for group in groups] + get_close_matches(name, commands, 1)
                parser.error(f"there is no command {name}" + (f" (did you mean {meant[0]}?)" if meant else ""))
            parser.parse_args(words)
        chosen, prog, words = commands[name], f"{prog} {name}", words[1:]
        if isinstance(chosen, str):
            return read(_class(chosen), words, prog)
        commands = chosen


def _overview(commands: Commands, prog: str) -> Parser:
    """Return a parser that lists commands, and refuses to be without one."""
    parser = Parser(prog=prog, description=ABOUT.get(prog.rsplit(maxsplit=1)[-1], DESCRIPTION))
    if commands is COMMANDS:
        parser.add_argument("--version", action="version", version=f"kornia-tidy {kornia_tidy.__version__}")
    actions = parser.add_subparsers(required=True, metavar="COMMAND", title="commands")
    for name, chosen in commands.items():
        actions.add_parser(name, help=documented(_class(chosen))[0] if isinstance(chosen, str) else ABOUT[name])
    return parser


def _class(path: str) -> type:
    """Return the class of a command."""
    module, _, name = path.partition(":")
    return getattr(import_module(f"kornia_tidy.cli.{module}"), name)


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
