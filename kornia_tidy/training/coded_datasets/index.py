"""Index of a coded data set: one line per item with the place of each map."""

from __future__ import annotations

import re
import tarfile
from collections.abc import Iterable, Mapping
from pathlib import Path, PurePosixPath
from typing import Any

from kornia_tidy.files import check_file, csv_bytes, parse_json, read_bytes, read_csv, read_json
from kornia_tidy.training.coded_datasets.item_files import ABOUT
from kornia_tidy.training.coded_datasets.layout import Layout, Part

INDEX = "index.csv"
Entry = dict[str, str]
_PLACE = re.compile(r"([^:\0]+)(?::(\d{1,15}):(\d{1,15}))?", re.ASCII)
_REMEDY = "delete it to have it rendered again"


def encode_index(folder: Path, parts: Iterable[Part], layout: Layout) -> bytes:
    """Return the index of finished parts as CSV: ``key,name,clamped_pixels`` and the place of each map.

    Convention:
        A place is a path in the folder, or ``shard:offset:size`` in bytes, so that no shard has to be searched.
    """
    names = ("key", "name", "clamped_pixels", *layout.fields)
    paths = (folder / part.name for part in parts)
    entries = (
        each
        for path in paths
        for each in ([_folder_entry(path)] if layout.shard_items is None else _shard_entries(path))
    )
    return csv_bytes([names, *([entry.get(name, "") for name in names] for entry in entries)])


def read_index(folder: Path) -> list[Entry]:
    """Return the lines of a folder's index.

    Raises:
        FileNotFoundError: if the file is missing; it is written after the last capture.
        ValueError: if it is damaged.
    """
    path = folder / INDEX
    if not path.is_file():
        raise FileNotFoundError(
            f"{folder} has no {INDEX}, which rendering writes last: it has not ended, or is no such"
        )
    entries = read_csv(path)
    if not entries or not {"key", "name", "coded"} <= set(entries[0]) or any(map(_is_ragged, entries)):
        raise ValueError(f"cannot read {path}: it is no index of captures, or is damaged")
    return entries


def read_place(folder: Path, place: str) -> bytes:
    """Return the bytes at a place.

    Raises:
        FileNotFoundError: if the file is missing.
        ValueError: if the place is missing or outside the folder, or the file ends too early.
    """
    match = _PLACE.fullmatch(place)
    if match is None or PurePosixPath(match[1]).is_absolute() or ".." in PurePosixPath(match[1]).parts:
        raise ValueError(f"a place must be a path in {folder}, or shard:offset:size, got {place!r:.80}")
    path = folder / match[1]
    if match[2] is None:
        return read_bytes(path)
    offset, size = int(match[2]), int(match[3])
    there = check_file(path).stat().st_size  # before memory is allocated
    if offset + size > there:
        raise ValueError(f"cannot read {path}: it should hold {size} bytes at {offset}, it has {there} in all")
    with path.open("rb") as file:
        file.seek(offset)
        return file.read(size)


def _is_ragged(entry: Mapping[str | None, Any]) -> bool:
    """Return whether a line of CSV has cells without a heading, or too few cells."""
    return None in entry or None in entry.values()


def _folder_entry(path: Path) -> Entry:
    about = read_json(path / ABOUT)
    if not isinstance(about, dict):
        raise ValueError(f"cannot read {path / ABOUT}: it does not describe a capture; {_REMEDY}")
    return {"key": path.name, **about, **{file.stem: f"{path.name}/{file.name}" for file in path.iterdir()}}


def _shard_entries(path: Path) -> list[Entry]:
    entries: dict[str, Entry] = {}
    try:
        with tarfile.open(path, "r:") as shard:
            for member in shard:
                key, _, name = member.name.partition(".")
                entry = entries.setdefault(key, {"key": key})
                entry[name.partition(".")[0]] = f"{path.name}:{member.offset_data}:{member.size}"
        for entry in entries.values():
            entry.update(parse_json(read_place(path.parent, entry["scene"])))
    except (KeyError, TypeError, ValueError, tarfile.TarError) as error:
        raise ValueError(
            f"cannot read {path}: it is no shard of captures, or is damaged ({error!s:.200}); {_REMEDY}"
        ) from error
    return list(entries.values())
