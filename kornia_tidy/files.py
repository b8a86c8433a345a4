"""Whole files in and out: one sentence when reading fails, and writes that are never left half done."""

from __future__ import annotations

import os
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from uuid import uuid4


def read_bytes(path: str | os.PathLike[str]) -> bytes:
    """Read a whole file.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: if it is a folder or empty.
    """
    path = Path(path)
    if path.is_dir():
        raise ValueError(f"cannot read {path}: it is a folder")
    if not path.exists():
        raise FileNotFoundError(f"cannot read {path}: there is no such file")
    data = path.read_bytes()
    if not data:
        raise ValueError(f"cannot read {path}: the file is empty")
    return data


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
