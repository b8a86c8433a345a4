"""Where later imports and started processes look for code: installed packages, not the folder that is current by then.

Python puts the current folder on the path of ``python -c``, notebooks and the prompt, and looks it up anew at each
import. Worker processes and programs are looked up in a similar way. After a change into a folder of downloads, a
``rawpy.py`` or ``git`` that lies there would be run.
"""

from __future__ import annotations

import multiprocessing
import os
import shutil
import sys
from collections.abc import Generator
from contextlib import contextmanager
from importlib.machinery import PathFinder
from threading import RLock
from typing import Any

ROOT = os.path.abspath(os.sep)  # working folder of processes that need none
_STANDARD = os.path.dirname(os.path.abspath(os.__file__))
_SAFE = "PYTHONSAFEPATH"  # a process with this in its environment does not put the current folder on its path
EXTRAS = {
    "OpenEXR": "exr",
    "gradio": "app",
    "h5py": "data",
    "huggingface_hub": "hub",
    "lightning": "train",
    "matplotlib": "plot",
    "tensorboard": "train",
    "transformers": "baselines",
}
"""Extras of this package that install others; further packages are installed by their own names."""
_LOCK = RLock()  # sys.path and the environment belong to the process, so one thread at a time changes them
try:
    _START = os.getcwd()  # an absolute entry of the path with -m, and for "." in PYTHONPATH
except FileNotFoundError:
    _START = ""


def import_installed(name: str) -> Any:
    """Import a module on first use, as ``import`` does, but not from the folder that is current by then.

    Raises:
        ImportError: if it is not installed.

    Example:
        >>> import_installed("zlib").crc32(b"")
        0
    """
    with _LOCK:
        before = sys.path
        sys.path = _absolute()
        try:
            __import__(name)
            return sys.modules[name]
        finally:
            before += [entry for entry in sys.path if entry not in before]  # a package may have added folders
            sys.path = before


def import_extra(name: str, user: str) -> Any:
    """Import a module of a package that only some users need, as :func:`import_installed` does.

    Args:
        name: of the module.
        user: needs the package, for the message.

    Raises:
        ImportError: if it cannot be imported, with the line that installs it.

    Example:
        >>> import_extra("zlib", "a compressed file").crc32(b"")
        0
    """
    try:
        return import_installed(name)
    except (ImportError, RuntimeError) as error:
        raise missing(name, user, error) from None


def missing(name: str, user: str, error: Exception) -> ImportError:
    """Return the error for a module that cannot be imported, with the line that installs its package.

    Args:
        name: of the module.
        user: needs the package, for the message.
        error: of the import. The message quotes it, unless it only says that the package is not installed.

    Example:
        >>> missing("matplotlib.figure", "a picture", ModuleNotFoundError(name="matplotlib"))
        ImportError("a picture needs matplotlib: pip install 'kornia-tidy[plot]'")
        >>> missing("torchvision", "Depth", RuntimeError("operator torchvision::nms does not exist"))
        ImportError('Depth needs torchvision: pip install torchvision (operator torchvision::nms does not exist)')
    """
    package = name.partition(".")[0]
    line = f"'kornia-tidy[{EXTRAS[package]}]'" if package in EXTRAS else package
    absent = isinstance(error, ModuleNotFoundError) and (error.name or "").partition(".")[0] == package
    reason = "" if absent else f" ({error})"
    return ImportError(f"{user} needs {package}: pip install {line}{reason}")


def package_folders(*names: str) -> list[str]:
    """Return the entries of ``sys.path`` that hold installed packages, for a process that needs only these.

    Args:
        *names: of packages. One that is not found is left out.

    Convention:
        - Site packages go before ``PYTHONPATH`` and the folder of the script, and the folder of the start goes last.
        - A package that has been imported from the current folder is found there, if it is not installed.

    Example:
        >>> [folder] = package_folders("torch")
        >>> os.path.isdir(os.path.join(folder, "torch"))
        True
    """
    entries = _absolute()
    after = entries.index(_STANDARD) if _STANDARD in entries else 0
    entries = [*entries[after:], *sorted(entries[:after], key=lambda entry: entry == _START)]
    loaded = [
        os.path.dirname(os.path.dirname(str(sys.modules[name].__file__))) for name in names if name in sys.modules
    ]
    found: list[str] = []
    for name in names:
        specs = ((entry, PathFinder.find_spec(name, [entry])) for entry in [*entries, *loaded])
        found += next(([entry] for entry, spec in specs if spec is not None and spec.origin is not None), [])
    return list(dict.fromkeys(found))


def find_program(name: str) -> str:
    """Return the path of a program, from the absolute entries of ``PATH``: others depend on the current folder.

    Raises:
        FileNotFoundError: if the file is missing.
    """
    entries = filter(os.path.isabs, os.environ.get("PATH", os.defpath).split(os.pathsep))
    found = shutil.which(name, path=os.pathsep.join(entries))
    if found is None or not os.path.isabs(found):  # on Windows the current folder is searched as well
        raise FileNotFoundError(f"there is no program {name} in the folders of PATH")
    return found


@contextmanager
def starting_workers() -> Generator[None]:
    """Keep the current folder off the path of worker processes that start in a block, unless they are forks.

    ``multiprocessing`` starts others with ``python -c``, which would import its first modules from there.
    """
    if multiprocessing.get_start_method() == "fork":
        yield
        return
    with _LOCK:
        before = os.environ.get(_SAFE)
        os.environ[_SAFE] = "1"
        try:
            yield
        finally:
            del os.environ[_SAFE]
            if before is not None:
                os.environ[_SAFE] = before


def _absolute() -> list[str]:
    """Return the entries of ``sys.path`` that do not depend on the current folder."""
    return [entry for entry in sys.path if os.path.isabs(entry)]
