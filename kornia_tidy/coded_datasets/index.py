"""Index of a coded data set: one line per item with the place of each of its maps."""

from __future__ import annotations

import csv
import io
import tarfile
from collections.abc import Iterable
from pathlib import Path

from kornia_tidy.coded_datasets.item_files import ABOUT
from kornia_tidy.coded_datasets.layout import Layout, Part
from kornia_tidy.files import parse_json, read_bytes, read_json

INDEX = "index.csv"
Entry = dict[str, str]


def encode_index(folder: Path, parts: Iterable[Part], layout: Layout) -> bytes:
    """Return the index of finished parts as CSV: ``key,name,clamped_pixels`` and the place of each map.

    Convention:
        A place is a path in the folder, or ``shard:offset:size`` in bytes, so that no shard has to be searched.
    """
    text = io.StringIO()
    names = ("key", "name", "clamped_pixels", *layout.fields)
    writer = csv.DictWriter(text, names, lineterminator="\n", extrasaction="ignore")
    writer.writeheader()
    for part in parts:
        path = folder / part.name
        writer.writerows([_folder_entry(path)] if layout.shard_items is None else _shard_entries(path))
    return text.getvalue().encode()


def read_index(folder: Path) -> list[Entry]:
    """Return the lines of a folder's index.

    Raises:
        FileNotFoundError: if there is none; it is written after the last capture.
        ValueError: if it is damaged.
    """
    path = folder / INDEX
    if not path.is_file():
        raise FileNotFoundError(
            f"{folder} has no {INDEX}, which rendering writes last: it has not ended, or is no such"
        )
    try:
        entries = list(csv.DictReader(io.StringIO(read_bytes(path).decode()), strict=True))
    except (csv.Error, ValueError) as error:
        raise ValueError(f"cannot read {path}: {error}") from error
    if not entries or not {"key", "name", "coded"} <= set(entries[0]) or any(None in e.values() for e in entries):
        raise ValueError(f"cannot read {path}: it is no index of captures, or is damaged")
    return entries


def read_place(folder: Path, place: str) -> bytes:
    """Return the bytes at a place.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if the file ends too early.
    """
    name, *window = place.split(":")
    if not window:
        return read_bytes(folder / name)
    offset, size = map(int, window)
    with (folder / name).open("rb") as file:
        file.seek(offset)
        data = file.read(size)
    if len(data) != size:
        raise ValueError(f"cannot read {folder / name}: it should hold {size} bytes at {offset}, there are {len(data)}")
    return data


def _folder_entry(path: Path) -> Entry:
    about = read_json(path / ABOUT)
    return {"key": path.name, **about, **{file.stem: f"{path.name}/{file.name}" for file in path.iterdir()}}


def _shard_entries(path: Path) -> list[Entry]:
    entries: dict[str, Entry] = {}
    with tarfile.open(path, "r:") as shard:
        for member in shard:
            key, _, name = member.name.partition(".")
            entry = entries.setdefault(key, {"key": key})
            entry[name.partition(".")[0]] = f"{path.name}:{member.offset_data}:{member.size}"
    for entry in entries.values():
        entry.update(parse_json(read_place(path.parent, entry["scene"])))
    return list(entries.values())
