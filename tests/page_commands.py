"""Commands in the shell blocks of pages: their arguments are read by their own parsers, or they are run, made small.

A misspelled option, target, extra or file is an error in both. Commands of a checkout are run in a folder that looks
like one, whose environment borrows the packages of this one: nothing is downloaded, and nothing is installed.
"""

from __future__ import annotations

import argparse
import importlib.util
import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tomllib
import venv
import warnings
from pathlib import Path
from unittest.mock import patch

import pytest

from kornia_tidy.cli.command_line import read_command

ROOT = Path(__file__).resolve().parents[1]
STOPS = {"|", "||", "&&", ";", ">"}  # what ends a command in a recipe of make
BUILTIN = {"mkdir", "source", "tee"}
FEW_TESTS = "-n0 tests/test_seeds.py"
NO_INDEX = re.compile(r"No matching distribution found|Could not find a version|Connection|timed out|resolution")
LONGEST = 240  # seconds of one command that is run


class ArgumentsRead(BaseException):  # venv turns any Exception into an exit
    """A command has read its arguments."""


def check_arguments(words: list[str], place: str) -> None:
    """Let a command read its arguments, and stop it there; an error names the page and the line."""
    while "=" in words[0]:  # a variable of the environment
        words = words[1:]
    program, arguments = words[0].rpartition("/")[2], words[1:]
    if program.startswith("python"):
        module = arguments[1] if arguments[0] == "-m" else ""
        if module in ("pip", "pytest"):
            program, arguments = module, arguments[2:]
    try:
        if program == "make":
            for line in recipe(arguments):
                check_arguments(line, place)
        else:
            read_arguments(program, arguments)
    except SystemExit as leaving:
        if leaving.code:
            raise AssertionError(f"{place}: {program} refuses {shlex.join(arguments)}") from leaving
    except (ValueError, pytest.UsageError) as error:
        raise AssertionError(f"{place}: {' '.join(str(error).split())}") from error


def check_command(words: list[str], place: str) -> None:
    """Check that a target of make or a module is there, and let the module read its arguments if it has any."""
    if words[0] == "make":
        recipe(words[1:])
    elif len(words) > 3:
        check_arguments(words, place)
    else:
        assert find_module(words[2]), f"{place}: there is no {words[2]}"


def find_module(name: str) -> bool:
    """Return whether a module is there."""
    try:
        return importlib.util.find_spec(name) is not None
    except ModuleNotFoundError:
        return False


def read_arguments(program: str, arguments: list[str]) -> None:
    """Let a program read its arguments, and stop it there."""
    if program == "kornia-tidy":
        read_command(arguments)
    elif program == "pip":
        check_pip(arguments)
    elif program == "pytest":
        pytest.Config.fromdictargs({}, arguments)
    elif program.startswith("python"):
        run_until_read(arguments)
    elif program not in BUILTIN:
        raise ValueError(f"{program} is not known here")


def outside() -> dict[str, str]:
    """Return the environment without what make (its variables ``ARGS``, too) and pytest tell those that they call."""
    told = ("MAKE", "MFLAGS", "ARGS", "PYTEST_")
    return {name: value for name, value in os.environ.items() if not name.startswith(told)}


def recipe(arguments: list[str]) -> list[list[str]]:
    """Return the commands that make would run for targets, without those that set up the environment."""
    if shutil.which("make") is None:
        pytest.skip("make is not installed")
    old = [f"--old-file=.venv/{stamp}" for stamp in (".ready", ".docs-ready", ".wheel-ready")]
    done = subprocess.run(
        ["make", "--dry-run", *old, *arguments], cwd=ROOT, env=outside(), capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise ValueError(done.stderr.strip().splitlines()[-1])
    lines = [shlex.split(line) for line in done.stdout.replace("\\\n", " ").splitlines()]
    return [[*words[: next((n for n, word in enumerate(words) if word in STOPS), None)]] for words in lines if words]


def check_pip(arguments: list[str]) -> None:
    """Look up the extras and the files that pip is given, and let pip read its options."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    wanted = {extra for word in arguments for part in re.findall(r"\[([\w,]+)\]", word) for extra in part.split(",")}
    if gone := sorted(wanted - set(extras)):
        raise ValueError(f"there are no extras {gone}")
    if importlib.util.find_spec("pip") is not None:
        from pip._internal.commands import create_command

        command, *rest = arguments
        options, _ = create_command(command).parse_args(rest)
        if gone := [name for name in options.constraints if not (ROOT / name).is_file()]:
            raise ValueError(f"there is no {gone[0]}")


def run_until_read(words: list[str]) -> None:
    """Run a Python module (`-m NAME ...`) or script (`FILE ...`) until its parser has read the arguments."""
    file, *arguments = words
    module = ""
    if file == "-m":
        module, *arguments = arguments
        found = importlib.util.find_spec(module)
        if found is not None and found.submodule_search_locations is not None:
            found = importlib.util.find_spec(f"{module}.__main__")
        if found is None or found.origin is None:
            raise ValueError(f"there is no {module}")
        path = Path(found.origin)
        path = path.with_name("__init__.py") if module == "venv" else path
    else:
        path = ROOT / file
        if not path.is_file():
            raise ValueError(f"there is no {file}")
    if "parse_args(" not in path.read_text(encoding="utf-8"):
        raise ValueError(f"{module or file} has no parser of its arguments")
    parse = argparse.ArgumentParser.parse_args

    def parse_and_stop(parser: argparse.ArgumentParser, *given: object) -> None:
        parse(parser, *given)
        raise ArgumentsRead

    with (
        patch.object(argparse.ArgumentParser, "parse_args", parse_and_stop),
        patch.object(sys, "argv", [str(path), *arguments]),
        patch.object(sys, "path", [str(ROOT), *sys.path]),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore", RuntimeWarning)  # of a module that another test has imported
        try:
            if module:
                runpy.run_module(module, run_name="__main__")
            else:
                runpy.run_path(str(path), run_name="__main__")
        except ArgumentsRead:
            pass


def make_checkout(folder: Path) -> None:
    """Make a folder into a checkout by links to the files, with an environment in `.venv`."""
    for path in ROOT.iterdir():
        if path.name not in (".git", ".venv", "outputs"):
            (folder / path.name).symlink_to(path)
    venv.create(folder / ".venv", symlinks=True)
    paths = sysconfig.get_paths(vars={name: str(folder / ".venv") for name in ("base", "platbase")})
    borrowed = [path for path in sys.path if path.endswith("-packages")]
    Path(paths["purelib"], "borrowed.pth").write_text("\n".join([*borrowed, str(folder)]), encoding="utf-8")
    script = Path(paths["scripts"], "kornia-tidy")
    script.write_text(f"#!{paths['scripts']}/python\nfrom kornia_tidy.cli import main\nraise SystemExit(main())\n")
    script.chmod(0o755)
    (folder / ".venv" / ".ready").touch()


def run_in_checkout(words: list[str], folder: Path, place: str) -> str:
    """Run a command in a folder of `make_checkout`, with few tests and without installing; return what it prints."""
    python = [str(folder / ".venv" / "bin" / "python")]
    if words[0] == "source":
        return ""  # the environment is that of the folder
    if words[:2] == ["make", "test"]:
        words = [*words, f"ARGS={FEW_TESTS}"]
    elif words[0] == "pip":
        words = [*python, "-m", *words]
    elif words[0] == "python":
        words = [*python, *words[1:]]
    if "pytest" in words:
        words = [*words, *FEW_TESTS.split()]
    if "pip" in words:
        words = [*words, "--dry-run", "--no-deps", "--quiet"]
    environment = {**outside(), "PYTHONPATH": str(folder), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        words, cwd=folder, env=environment, capture_output=True, text=True, timeout=LONGEST, check=False
    )
    if done.returncode and "pip" in words and NO_INDEX.search(done.stderr):
        pytest.skip("there is no package index at hand")
    assert done.returncode == 0, f"{place} ends with {done.returncode}: {shlex.join(words)}\n{done.stdout}{done.stderr}"
    return done.stdout
