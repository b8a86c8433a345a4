"""Whole files in and out: one sentence when reading fails, and writes that are never left half done."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from pathlib import Path
from uuid import uuid4

_LEFTOVER = re.compile(r"\.[0-9a-f]{32}\.tmp")  # what the writers below call files and folders until they are whole


def read_bytes(path: str | os.PathLike[str]) -> bytes:
    """Read a whole file.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: if it is a folder or empty.
    """
    path = check_file(path)
    data = path.read_bytes()
    if not data:
        raise ValueError(f"cannot read {path}: the file is empty")
    return data


def check_file(path: str | os.PathLike[str]) -> Path:
    """Return the path of a file that is there.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: if it is a folder.
    """
    path = Path(path)
    if path.is_dir():
        raise ValueError(f"cannot read {path}: it is a folder")
    if not path.exists():
        raise FileNotFoundError(f"cannot read {path}: there is no such file")
    return path


def write_bytes(path: str | os.PathLike[str], data: bytes) -> None:
    """Write a file so that nobody ever sees half of it: under another name in the same folder, then renamed.

    Raises:
        FileNotFoundError: if the folder does not exist.
        ValueError: if the path is a folder.
    """
    with replacing(path) as temporary:
        temporary.write_bytes(data)


@contextmanager
def replacing(path: str | os.PathLike[str]) -> Generator[Path]:
    """Give another name in the same folder to write to; what is written there takes the file's place, if all went well.

    Raises:
        FileNotFoundError: if the folder does not exist.
        ValueError: if the path is a folder.
    """
    path = Path(path)
    if not path.parent.is_dir():
        raise FileNotFoundError(f"cannot write {path}: there is no folder {path.parent}")
    if path.is_dir():
        raise ValueError(f"cannot write {path}: it is a folder")
    temporary = path.with_name(f".{uuid4().hex}.tmp")
    try:
        yield temporary
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)


def write_folder(path: str | os.PathLike[str], files: Mapping[str, bytes], replace: bool = False) -> None:
    """Write a folder of files so that nobody ever sees a part of it: under another name beside it, then renamed.

    Args:
        path: where to; with ``replace`` a folder of this name is replaced as a whole.
        files: contents by name.
        replace: whether there may be one.

    Raises:
        FileExistsError: if there is something of this name that is not to be replaced.
        FileNotFoundError: if the folder it is to lie in does not exist.
    """
    path = Path(path).absolute()
    if not path.parent.is_dir():
        raise FileNotFoundError(f"cannot write {path}: there is no folder {path.parent}")
    if path.exists() and not (replace and path.is_dir()):
        raise FileExistsError(f"cannot write {path}: it exists")
    new, old = (path.with_name(f".{uuid4().hex}.tmp") for _ in range(2))
    try:
        new.mkdir()
        for name, data in files.items():
            (new / name).write_bytes(data)
        if path.exists():
            path.rename(old)
        try:
            new.rename(path)
        except OSError:
            if old.exists():
                old.rename(path)
            raise
    finally:
        shutil.rmtree(new, ignore_errors=True)
        if path.exists():
            shutil.rmtree(old, ignore_errors=True)


def remove_leftovers(folder: str | os.PathLike[str]) -> None:
    """Remove from a folder what writers left that were killed at work. Nobody may be writing into it."""
    for path in Path(folder).iterdir():
        if _LEFTOVER.fullmatch(path.name):
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)
