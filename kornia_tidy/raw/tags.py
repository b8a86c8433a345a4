"""Reader of the TIFF tags of raw files: names, exposure, levels, filter array and colours.

LibRaw's Python package does not return the manufacturer, black levels that differ within a large tile, and the colour
matrix of Kodak's first cameras. The tags of a damaged file may hold any value. The decoder process runs this file, so
it imports only the standard library. ExifRead and tifffile are not used: of 51 raw files tried they read nothing from
12, which are CRW, CR3, RAF and QuickTake files.

Source: TIFF 6.0, section 2; TIFF/EP, CFAPattern; Exif 2.32, 4.6; DNG 1.7, BlackLevel, WhiteLevel, CFAPlaneColor and
CFALayout; P. Harvey's notes on Canon's CRW format; dcraw for Kodak's matrix.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator, Sequence
from datetime import datetime
from typing import Any

TYPES = {1: "B", 2: "s", 3: "H", 4: "I", 5: "II", 7: "s", 10: "ii", 11: "f", 12: "d", 13: "I"}  # of TIFF's fields
SUB_DIRECTORIES = (0x014A, 0x8769)  # SubIFDs, Exif
MOST_DIRECTORIES, MOST_ENTRIES, MOST_BYTES = 32, 512, 1 << 16
MOST_SHOWN = 8  # numbers in a message

TEXTS = {"make": (0x010F,), "model": (0x0110, 0xC614), "lens": (0xA434,)}
NUMBERS = {"iso": (0x8827,), "exposure": (0x829A,), "aperture": (0x829D,), "focal_length": (0x920A,)}
TIMES = (0x9003, 0x0132)
NOISE_PROFILE = 0xC761
SUBFILE_TYPE, DNG_VERSION, BLACK_REPEAT, BLACK_LEVEL = 0x00FE, 0xC612, 0xC619, 0xC61A
WHITE_LEVEL, KODAK_MATRIX = 0xC61D, 0x9218
PHOTOMETRIC, FILTER_ARRAY = 0x0106, 32803  # the tag, and its value for a picture behind a filter array
FILTER_REPEAT, FILTER_PATTERN, FILTER_COLORS, FILTER_LAYOUT = 0x828D, 0x828E, 0xC616, 0xC617
LARGEST_FILTER_TILE = 8  # rows or columns; DNG names no limit, X-Trans has 6
COLOR_CODES = range(7)  # red, green, blue, cyan, magenta, yellow, white
EXTENTS = ((0x0111, 0x0117), (0x0144, 0x0145))  # offsets and lengths of strips and of tiles
QUICKTAKE = {b"qktk": "QuickTake 100", b"qktn": "QuickTake 150"}
CIFF_NAMES, CIFF_HEAPS = 0x080A, (0x28, 0x30)

# Tags that are read; a hostile file may hold 64 KiB behind each of the others.
WANTED = frozenset(
    [tag for tags in (*TEXTS.values(), *NUMBERS.values(), TIMES, *EXTENTS) for tag in tags]
    + [NOISE_PROFILE, SUBFILE_TYPE, DNG_VERSION, BLACK_REPEAT, BLACK_LEVEL, WHITE_LEVEL, KODAK_MATRIX, PHOTOMETRIC]
    + [FILTER_REPEAT, FILTER_PATTERN, FILTER_COLORS, FILTER_LAYOUT, *SUB_DIRECTORIES]
)

Directory = dict[int, tuple[Any, ...]]


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
    if data[6:14] == b"HEAPCCDR":
        found["make"], found["model"] = _ciff_names(data)
    if data[:4] in QUICKTAKE:
        found["make"], found["model"] = "Apple", QUICKTAKE[data[:4]]
    return {name: value for name, value in found.items() if value is not None}


def black_tile(data: bytes) -> list[list[float]] | None:
    """Return the black levels of a DNG by rows if they repeat over more than 2x2 pixels, else None."""
    for directory in tiff_directories(data):
        rows, columns = (*_whole_numbers(directory, BLACK_REPEAT), 1, 1)[:2]
        levels = directory.get(BLACK_LEVEL, ())
        if max(rows, columns) > 2 and len(levels) == rows * columns and all(map(math.isfinite, levels)):
            return [list(levels[row * columns : (row + 1) * columns]) for row in range(rows)]
    return None


def white_levels(data: bytes) -> set[int]:
    """Return all white levels of a DNG, including those of its previews."""
    return {level for directory in tiff_directories(data) for level in _whole_numbers(directory, WHITE_LEVEL)}


def filter_array_fault(data: bytes) -> str | None:
    """Return the contradiction among the filter array tags of a DNG, in words; None for valid tags and other files.

    LibRaw reads beyond its tables if a pattern has unknown colours, and assumes another array or none if the sizes do
    not fit. All directories are tested, as LibRaw takes the pattern from any of them.

    Example:
        >>> filter_array_fault(b"no DNG") is None
        True
    """
    directories = list(tiff_directories(data))
    if not directories or DNG_VERSION not in directories[0]:
        return None
    faults = [_fault(one) for one in directories if FILTER_PATTERN in one or _behind_filters(one)]
    return next((fault for fault in faults if fault), None)


def _behind_filters(directory: Directory) -> bool:
    return FILTER_ARRAY in directory.get(PHOTOMETRIC, ())


def _fault(directory: Directory) -> str | None:
    """Return the contradiction among the filter array tags of one directory, in words, or None."""
    pattern = _codes(directory, FILTER_PATTERN)
    if not pattern:
        return "its CFAPattern is missing or cannot be read"
    size = _whole_numbers(directory, FILTER_REPEAT)
    rows, columns = size if len(size) == 2 else (0, 0)
    if not (0 < rows <= LARGEST_FILTER_TILE and 0 < columns <= LARGEST_FILTER_TILE):
        return f"its CFARepeatPatternDim is {_listed(size)}, not two numbers from 1 to {LARGEST_FILTER_TILE}"
    if len(pattern) != rows * columns:
        return f"its CFAPattern has {len(pattern)} entries, its CFARepeatPatternDim says {rows} x {columns}"
    colors = _codes(directory, FILTER_COLORS) if FILTER_COLORS in directory else (0, 1, 2)
    if not 0 < len(colors) == len(set(colors) & set(COLOR_CODES)):
        return f"its CFAPlaneColor is {_listed(colors)}, not different colours from 0 to {COLOR_CODES[-1]}"
    if beyond := sorted(set(pattern) - set(colors)):
        return f"its CFAPattern holds {_listed(beyond)}, which is not among its colours {_listed(colors)}"
    layout = _whole_numbers(directory, FILTER_LAYOUT) if FILTER_LAYOUT in directory else (1,)
    if layout != (1,):
        return f"its CFALayout is {_listed(layout)}, and only 1, pixels in rows and columns, can be decoded"
    return None


def _codes(directory: Directory, tag: int) -> tuple[int, ...]:
    """Return the values of a tag of type BYTE or UNDEFINED."""
    values = directory.get(tag, ())
    return tuple(values[0]) if values and isinstance(values[0], bytes) else _whole_numbers(directory, tag)


def _listed(values: Sequence[int]) -> str:
    shown = " ".join(map(str, values[:MOST_SHOWN])) or "empty"
    return shown if len(values) <= MOST_SHOWN else f"{shown} ..."


def kodak_matrix(data: bytes) -> list[list[float]] | None:
    """Return the matrix from camera colours to RGB of a KDC file, by rows, or None; an offset precedes each row."""
    for directory in tiff_directories(data):
        values = directory.get(KODAK_MATRIX, ())
        if len(values) == 12 and not isinstance(values[0], bytes):
            return [list(values[row + 1 : row + 4]) for row in (0, 4, 8)]
    return None


def missing_bytes(data: bytes) -> int:
    """Return the number of bytes of a DNG's picture beyond the end of the file; LibRaw leaves lost tiles empty."""
    directories = list(tiff_directories(data))
    if not directories or DNG_VERSION not in directories[0]:
        return 0
    whole = [directory for directory in directories if not any(_whole_numbers(directory, SUBFILE_TYPE)[:1])]
    ends = [
        offset + length
        for directory in whole
        for offsets, lengths in EXTENTS
        for offset, length in zip(_whole_numbers(directory, offsets), _whole_numbers(directory, lengths), strict=False)
    ]
    return max(0, max(ends, default=0) - len(data))


def _whole_numbers(directory: Directory, tag: int) -> tuple[int, ...]:
    """Return the integer values of a tag; empty if it is missing or has another type."""
    values = directory.get(tag, ())
    return tuple(values) if all(type(value) is int for value in values) else ()


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
            below = [offset for tag in SUB_DIRECTORIES for offset in _whole_numbers(directory, tag)[:MOST_DIRECTORIES]]
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
    directory: Directory = {}
    for entry in range(start + 2, start + 2 + 12 * count, 12):
        tag, kind, number = _unpack(data, f"{order}HHI", entry) or (0, 0, 0)
        if tag in WANTED:
            values = _entry_values(data, base, order, entry + 8, kind, number)
            # Of two different values LibRaw may use the other one.
            directory[tag] = values if directory.get(tag, values) == values else ()
    return directory, _unpack(data, f"{order}I", start + 2 + 12 * count)


def _entry_values(data: bytes, base: int, order: str, field: int, kind: int, number: int) -> tuple[Any, ...]:
    """Return the values of an entry, stored in its last field or at the offset given there."""
    code = TYPES.get(kind, "")
    size = number * struct.calcsize(f"={code}")
    if not 0 < size <= MOST_BYTES:
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


def _ciff_names(data: bytes) -> tuple[str | None, str | None]:
    """Return make and model from the heaps of Canon's CRW, each of which ends with the offset of its record list."""
    waiting = [((_unpack(data, "<I", 2) or (0,))[0], len(data))]
    for _ in range(MOST_DIRECTORIES):
        if not waiting:
            break
        start, end = waiting.pop(0)
        table = start + (_unpack(data, "<I", end - 4) or (0,))[0]
        count = min((_unpack(data, "<H", table) or (0,))[0], MOST_ENTRIES)
        for entry in range(table + 2, table + 2 + 10 * count, 10):
            kind, size, offset = _unpack(data, "<HII", entry) or (0, 0, 0)
            if kind == CIFF_NAMES:
                names = data[start + offset : start + offset + min(size, MOST_BYTES)]
                make, model = [*names.split(b"\0"), b"", b""][:2]
                return _text((make,)), _text((model,))
            if kind >> 8 in CIFF_HEAPS:
                waiting.append((start + offset, start + offset + size))
    return None, None
