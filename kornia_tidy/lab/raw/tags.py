"""Reader of the TIFF tags of raw files: directories with their values, names, exposure and colours.

LibRaw's Python package does not return the manufacturer and the colour matrix of Kodak's first cameras. The tags of a
damaged file may hold any value. The decoder process runs this file, so it imports only the standard library. ExifRead
and tifffile are not used: of 51 raw files tried they read nothing from 12, such as CR3 and RAF files.

Source: TIFF 6.0, section 2; Exif 2.32, 4.6; dcraw for Kodak's matrix.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from datetime import datetime
from typing import Any

TYPES = {1: "B", 2: "s", 3: "H", 4: "I", 5: "II", 7: "s", 10: "ii", 11: "f", 12: "d", 13: "I"}  # of TIFF's fields
SUB_DIRECTORIES = (0x014A, 0x8769)  # SubIFDs, Exif
MOST_DIRECTORIES, MOST_ENTRIES, MOST_BYTES = 32, 512, 1 << 16
MOST_LONG_BYTES = 1 << 22  # of a tag that is read for one directory only, such as a gain map

TEXTS = {"make": (0x010F,), "model": (0x0110, 0xC614), "lens": (0xA434,)}
NUMBERS = {"iso": (0x8827,), "exposure": (0x829A,), "aperture": (0x829D,), "focal_length": (0x920A,)}
TIMES = (0x9003, 0x0132)
NOISE_PROFILE, KODAK_MATRIX, ORIENTATION = 0xC761, 0x9218, 0x0112
# The picture of a DNG and how it is stored
SUBFILE_TYPE, WIDTH, HEIGHT, BITS, COMPRESSION, PHOTOMETRIC = 0x00FE, 0x0100, 0x0101, 0x0102, 0x0103, 0x0106
SAMPLES, ROWS_PER_STRIP, PLANAR, PREDICTOR, SAMPLE_FORMAT = 0x0115, 0x0116, 0x011C, 0x013D, 0x0153
STRIPS, TILES, TILE_SIZE = (0x0111, 0x0117), (0x0144, 0x0145), (0x0142, 0x0143)  # offsets and lengths; columns, rows
# Its sensor
FILTER_REPEAT, FILTER_PATTERN, FILTER_COLORS, FILTER_LAYOUT = 0x828D, 0x828E, 0xC616, 0xC617
DNG_VERSION, LINEARIZATION, BLACK_REPEAT, BLACK_LEVEL, BLACK_COLUMNS, BLACK_ROWS = 0xC612, *range(0xC618, 0xC61D)
WHITE_LEVEL, NEUTRAL, ACTIVE_AREA, OPCODE_LISTS = 0xC61D, 0xC628, 0xC68D, (0xC740, 0xC741, 0xC74E)
INTERLEAVED = {0xC71E: "SubTileBlockSize", 0xC71F: "RowInterleaveFactor", 0xCD43: "ColumnInterleaveFactor"}

# Tags that are read; a hostile file may hold 64 KiB behind each of the others.
WANTED = frozenset(
    [tag for tags in (*TEXTS.values(), *NUMBERS.values(), TIMES, STRIPS, TILES, TILE_SIZE) for tag in tags]
    + [NOISE_PROFILE, KODAK_MATRIX, ORIENTATION, SUBFILE_TYPE, WIDTH, HEIGHT, BITS, COMPRESSION, PHOTOMETRIC, SAMPLES]
    + [ROWS_PER_STRIP, PLANAR, PREDICTOR, SAMPLE_FORMAT, FILTER_REPEAT, FILTER_PATTERN, FILTER_COLORS, FILTER_LAYOUT]
    + [DNG_VERSION, BLACK_REPEAT, BLACK_LEVEL, WHITE_LEVEL, NEUTRAL, ACTIVE_AREA, *SUB_DIRECTORIES, *INTERLEAVED]
)


class Directory(dict[int, tuple[Any, ...]]):
    """Values of the wanted tags of a directory, and the places of all its entries; empty values cannot be read."""

    def __init__(self, base: int, order: str) -> None:
        super().__init__()
        self.base, self.order = base, order
        self.entries: dict[int, int] = {}  # offsets in the file

    def whole_numbers(self, tag: int) -> tuple[int, ...]:
        """Return the integer values of a tag; empty if it is missing or has another type."""
        values = self.get(tag, ())
        return tuple(values) if all(type(value) is int for value in values) else ()

    def codes(self, tag: int) -> tuple[int, ...]:
        """Return the values of a tag of type BYTE or UNDEFINED."""
        values = self.get(tag, ())
        return tuple(values[0]) if values and isinstance(values[0], bytes) else self.whole_numbers(tag)

    def long_values(self, data: bytes, tag: int) -> tuple[Any, ...]:
        """Return the values of a tag that may be long; empty if it is missing or cannot be read."""
        place = self.entries.get(tag, len(data))
        _, kind, number = _unpack(data, f"{self.order}HHI", place) or (0, 0, 0)
        return _entry_values(data, self.base, self.order, place + 8, kind, number, MOST_LONG_BYTES)


def camera_tags(data: bytes) -> dict[str, Any]:
    """Return camera and exposure data from the tags of a raw file, by the field names of RawInfo.

    Missing and invalid values are left out.

    Units: seconds, metres; the timestamp is an ISO 8601 string.
    """
    directories = list(tiff_directories(data))
    found: dict[str, Any] = {}
    for name, tags in TEXTS.items():
        found[name] = next((text for values in _values(directories, tags) if (text := _text(values))), None)
    for name, tags in NUMBERS.items():
        found[name] = next((n for values in _values(directories, tags) if (n := _number(values)) is not None), None)
    if found["focal_length"] is not None:
        found["focal_length"] *= 1e-3
    found["timestamp"] = next((t for values in _values(directories, TIMES) if (t := _time(_text(values)))), None)
    found["noise_profile"] = next((p for v in _values(directories, (NOISE_PROFILE,)) if (p := _noise_profile(v))), None)
    return {name: value for name, value in found.items() if value is not None}


def orientation_known(directories: list[Directory]) -> bool:
    """Return False if a file gives orientations, and none of them is one of Exif's eight.

    LibRaw takes the last three bits of any number: a quarter turn for 0, which means an unknown orientation.
    """
    given = [value for values in _values(directories, (ORIENTATION,)) for value in values]
    return not given or any(value in range(1, 9) for value in given)


def kodak_matrix(data: bytes) -> list[list[float]] | None:
    """Return the matrix from camera colours to RGB of a KDC file, by rows, or None; an offset precedes each row."""
    for directory in tiff_directories(data):
        values = directory.get(KODAK_MATRIX, ())
        if len(values) == 12 and not isinstance(values[0], bytes):
            return [list(values[row + 1 : row + 4]) for row in (0, 4, 8)]
    return None


def tiff_directories(data: bytes) -> Iterator[Directory]:
    """Yield the directories of a TIFF-like file as values by tag: the first, its subdirectories, and the next ones.

    The Exif blocks in the preview of a RAF file and in the boxes of a CR3 file are included. Each directory is read
    once, and their number and sizes are bounded, so that a hostile file cannot make this slow.
    """
    left = MOST_DIRECTORIES
    for base in _tiff_headers(data):
        order = "<" if data[base : base + 2] == b"II" else ">"
        waiting = list(_unpack(data, f"{order}I", base + 4, base))
        seen = {0, *waiting}  # 0: none follows
        while waiting and left:
            left -= 1
            directory, following = _directory(data, base, order, waiting.pop(0))
            below = [offset for tag in SUB_DIRECTORIES for offset in directory.whole_numbers(tag)[:MOST_DIRECTORIES]]
            fresh = [offset for offset in dict.fromkeys([*below, *following]) if offset not in seen]
            waiting += fresh
            seen.update(fresh)
            yield directory


def _tiff_headers(data: bytes) -> list[int]:
    """Return the offsets of possible TIFF headers."""
    places = [0] + [data.find(mark, 0, 1 << 16) + 4 for mark in (b"CMT1", b"CMT2")]
    places.append(data.find(b"Exif\0\0", 0, 1 << 12) + 6)
    return [
        place for place in places if data[place : place + 2] in {b"II", b"MM"} and data[place + 6 : place + 8] != b"HE"
    ]


def _directory(data: bytes, base: int, order: str, offset: int) -> tuple[Directory, tuple[Any, ...]]:
    """Return a directory and the offset of the next one; unreadable and contradictory tags have no values."""
    start = base + offset
    count = min((_unpack(data, f"{order}H", start) or (0,))[0], MOST_ENTRIES)
    directory = Directory(base, order)
    for entry in range(start + 2, start + 2 + 12 * count, 12):
        tag, kind, number = _unpack(data, f"{order}HHI", entry) or (0, 0, 0)
        directory.entries[tag] = entry
        if tag in WANTED:
            values = _entry_values(data, base, order, entry + 8, kind, number)
            # Of two different values LibRaw may use the other one.
            directory[tag] = values if directory.get(tag, values) == values else ()
    return directory, _unpack(data, f"{order}I", start + 2 + 12 * count)


def _entry_values(
    data: bytes, base: int, order: str, field: int, kind: int, number: int, most: int = MOST_BYTES
) -> tuple[Any, ...]:
    """Return the values of an entry, stored in its last field or at the offset given there."""
    code = TYPES.get(kind, "")
    size = number * struct.calcsize(f"={code}")
    if not 0 < size <= most:
        return ()
    place = _unpack(data, f"{order}I", field) if size > 4 else (field - base,)
    letters = f"{number}s" if code == "s" else code * number
    values = _unpack(data, order + letters, base + place[0]) if place else ()
    if len(code) == 2:
        values = tuple(a / b if b else math.nan for a, b in zip(values[::2], values[1::2], strict=True))
    return values


def _unpack(data: bytes, layout: str, offset: int, least: int = 0) -> tuple[Any, ...]:
    """Unpack the values at an offset; empty if they reach beyond the end of the file."""
    if offset < least or offset + struct.calcsize(layout) > len(data):
        return ()
    return struct.unpack_from(layout, data, offset)


def _values(directories: list[Directory], tags: tuple[int, ...]) -> Iterator[tuple[Any, ...]]:
    return (directory[tag] for tag in tags for directory in directories if tag in directory)


def _text(values: tuple[Any, ...]) -> str | None:
    """Return the printable characters of a text up to its first zero byte."""
    if not values or not isinstance(values[0], bytes):
        return None
    text = values[0].split(b"\0")[0].decode("utf-8", "ignore")
    return " ".join("".join(c for c in text if c.isprintable()).split())[:128] or None


def _number(values: tuple[Any, ...]) -> float | None:
    if not values or isinstance(values[0], bytes):
        return None
    return float(values[0]) if 0 < values[0] < 1e9 else None


def _noise_profile(values: tuple[Any, ...]) -> list[list[float]] | None:
    """Return scale and offset of the noise's variance, a pair for all colours or for each, or None if they are none."""
    if len(values) not in {2, 6, 8} or not all(isinstance(value, float) and 0 <= value < 1 for value in values):
        return None
    return [list(pair) for pair in zip(values[::2], values[1::2], strict=True)] if any(values) else None


def _time(text: str | None) -> str | None:
    try:
        return datetime.strptime(text or "", "%Y:%m:%d %H:%M:%S").isoformat()  # by the camera's clock
    except ValueError:
        return None
