"""Sensor of a DNG by its tags: which picture, its filter array, active area, levels, and opcodes that are not applied.

LibRaw names four colours GMCY whatever the file says, gives black levels of an odd active area to other places, knows
one white level, and averages black levels that differ by row or column. So the tags are read here, for every DNG. The
decoder process runs this file, so it imports only the standard library.

Source: Adobe, Digital Negative Specification 1.7; TIFF/EP for CFAPattern.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass

from . import tags
from .tags import Directory

FILTER_ARRAY, LINEAR_RAW = 32803, 34892  # values of PhotometricInterpretation
COLOR_LETTERS = "RGBCMYW"  # a letter's place is its code in CFAPattern and CFAPlaneColor
LARGEST_FILTER_TILE = 8  # rows or columns; DNG names no limit, X-Trans has 6
PERIODS = (2, 4, 6)  # of the filter arrays that can be read: Bayer and four colours, quad-Bayer, X-Trans
SIDES = 22, 64000  # of a picture that LibRaw opens
MOST_SHOWN = 8  # numbers in a message
UNSIGNED, FLOATING = 1, 3  # values of SampleFormat
LOSSY_JPEG = 34892  # value of Compression
COMPRESSIONS = {5: "LZW", 9: "VC-5", 32773: "PackBits", 34925: "LZMA", 50000: "Zstandard", 52546: "JPEG XL"}
DECODED = {1: "none", 7: "JPEG", 8: "Deflate", 32946: "Deflate", LOSSY_JPEG: "lossy JPEG"}
MAP_POLYNOMIAL, OPTIONAL = 8, 1  # an opcode, and the bit of its flags
OPCODES = (
    "WarpRectilinear", "WarpFisheye", "FixVignetteRadial", "FixBadPixelsConstant", "FixBadPixelsList", "TrimBounds",
    "MapTable", "MapPolynomial", "GainMap", "DeltaPerRow", "DeltaPerColumn", "ScalePerRow", "ScalePerColumn",
    "WarpRectilinear2",
)  # fmt: skip
MOST_OPCODES = 64


@dataclass(frozen=True)
class Sensor:
    """The raw picture of a DNG.

    Attributes:
        directory: its tags.
        width: of the stored picture, with masked borders.
        height: likewise.
        samples: number of samples of a pixel.
        bits: of a sample.
        floating: whether the samples are floating-point numbers.
        compression: TIFF's code.
        separate: whether the planes of the samples are stored one after the other.
        planes: letters of the colour planes; empty for a monochrome sensor.
        tile: letters of the filter array by rows, from the corner of the active area; None without one.
        area: active area: top, left, bottom, right.
        black: levels by rows, columns and samples, which repeat from the corner of the active area.
        black_columns: to be added to the black levels of each column of the active area; empty: nothing.
        black_rows: likewise, of each row.
        white: saturation level of each sample.
        neutral: samples of a neutral surface as shot, or empty.
    """

    directory: Directory
    width: int
    height: int
    samples: int
    bits: int
    floating: bool
    compression: int
    separate: bool
    planes: str
    tile: tuple[str, ...] | None
    area: tuple[int, ...]
    black: list[list[tuple[float, ...]]]
    black_columns: tuple[float, ...]
    black_rows: tuple[float, ...]
    white: tuple[float, ...]
    neutral: tuple[float, ...]


def dng_sensor(data: bytes, directories: list[Directory]) -> Sensor | None:
    """Return the sensor of a DNG; None for other files, and without a raw picture.

    Raises:
        ValueError: if the tags contradict each other, or describe what cannot be decoded.

    Example:
        >>> dng_sensor(b"no DNG", []) is None
        True
    """
    if not any(tags.DNG_VERSION in directory for directory in directories):
        return None
    for directory in directories:  # LibRaw takes the pattern from any of them, and reads beyond its tables
        if tags.FILTER_PATTERN in directory or _one(directory, tags.PHOTOMETRIC) == FILTER_ARRAY:
            _filter_array(directory)
    main = [d for d in directories if d.get(tags.WIDTH) and not any(d.whole_numbers(tags.SUBFILE_TYPE)[:1])]
    main = [d for d in main if _one(d, tags.PHOTOMETRIC) in {FILTER_ARRAY, LINEAR_RAW}]  # LibRaw decodes the first
    if not main:
        return None
    found, samples = main[0], _one(main[0], tags.SAMPLES, 1)
    width, height = _one(found, tags.WIDTH), _one(found, tags.HEIGHT)
    if not (SIDES[0] <= min(width, height) and max(width, height) <= SIDES[1]):
        raise ValueError(f"its picture has {width} x {height} pixels, and {SIDES[0]} to {SIDES[1]} can be decoded")
    bits, floating, compression = _sample_kind(found)
    tile, planes = (None, "")
    if _one(found, tags.PHOTOMETRIC) == FILTER_ARRAY:
        if samples != 1:
            raise ValueError(f"its picture behind a filter array has {samples} samples a pixel, not 1")
        tile, planes = _square_tile(*_filter_array(found))
    elif samples != 1:
        planes = _plane_names(found, samples)
    black, columns, rows = _black(data, found, directories[0], samples)
    area = found.whole_numbers(tags.ACTIVE_AREA) if tags.ACTIVE_AREA in found else (0, 0, height, width)
    if len(area) != 4 or not (0 <= area[0] < area[2] <= height and 0 <= area[1] < area[3] <= width):
        raise ValueError(f"its ActiveArea {_listed(area)} does not lie within its {width} x {height} pixels")
    if min(area[2] - area[0], area[3] - area[1]) < SIDES[0]:
        raise ValueError(f"its ActiveArea {_listed(area)} is smaller than {SIDES[0]} x {SIDES[0]} pixels")
    for name, levels, length in (
        ("BlackLevelDeltaH", columns, area[3] - area[1]),
        ("BlackLevelDeltaV", rows, area[2] - area[0]),
    ):
        if len(levels) not in {0, length}:
            raise ValueError(f"its {name} has {len(levels)} values for an active area of {length}")
    white = _white(found if tags.WHITE_LEVEL in found else directories[0], samples, 1 if floating else 2**bits - 1)
    separate = samples > 1 and _one(found, tags.PLANAR, 1) == 2
    neutral = found.get(tags.NEUTRAL) or directories[0].get(tags.NEUTRAL) or ()
    neutral = neutral if all(isinstance(value, int | float) and 0 < value < math.inf for value in neutral) else ()
    return Sensor(
        found, width, height, samples, bits, floating, compression, separate, planes, tile, area, black, columns,
        rows, white, neutral,
    )  # fmt: skip


def missing_bytes(data: bytes, directories: list[Directory]) -> int:
    """Return the number of bytes of a DNG's picture beyond the end of the file; LibRaw leaves lost tiles empty."""
    if not directories or tags.DNG_VERSION not in directories[0]:
        return 0
    whole = [directory for directory in directories if not any(directory.whole_numbers(tags.SUBFILE_TYPE)[:1])]
    ends = [
        offset + length
        for directory in whole
        for extents in (tags.STRIPS, tags.TILES)
        for offset, length in zip(*map(directory.whole_numbers, extents), strict=False)
    ]
    return max(0, max(ends, default=0) - len(data))


def ignored_opcodes(data: bytes, sensor: Sensor) -> list[str]:
    """Return the names of the opcodes of a DNG, which change its values and are not applied, in their order.

    LibRaw applies the polynomials that linearise lossy JPEG, and nothing else.
    """
    return [
        (OPCODES[code - 1] if 0 < code <= len(OPCODES) else f"opcode {code}") + (" (optional)" if optional else "")
        for tag in tags.OPCODE_LISTS
        for code, optional, _ in opcodes(data, sensor.directory, tag)
        if (sensor.compression, tag, code) != (LOSSY_JPEG, tags.OPCODE_LISTS[1], MAP_POLYNOMIAL)
    ]


def opcodes(data: bytes, directory: Directory, tag: int) -> list[tuple[int, bool, bytes]]:
    """Return the opcodes of a list: code, whether a reader may skip it, and parameters; up to a truncated one."""
    values = directory.long_values(data, tag)
    text = values[0] if values and isinstance(values[0], bytes) else b""
    found: list[tuple[int, bool, bytes]] = []
    place = 4
    for _ in range(min(int.from_bytes(text[:4], "big"), MOST_OPCODES)):
        if place + 16 > len(text):
            break
        code, _, flags, length = struct.unpack_from(">4I", text, place)
        place += 16 + length
        if place > len(text):
            break
        found.append((code, bool(flags & OPTIONAL), text[place - length : place]))
    return found


def shifted(tile: Sequence[str], down: int, right: int) -> list[str]:
    """Return a tile as it repeats from a place that lies rows down and columns right of its corner.

    Example:
        >>> shifted(["RG", "GB"], 1, 0)
        ['GB', 'RG']
    """
    rows, columns = len(tile), len(tile[0])
    return ["".join(tile[(y + down) % rows][(x + right) % columns] for x in range(columns)) for y in range(rows)]


# ---------------------------------------------------------------------- samples and levels


def _sample_kind(directory: Directory) -> tuple[int, bool, int]:
    """Return the bits of a sample, whether samples are floating-point numbers, and the compression."""
    bits, kinds = directory.whole_numbers(tags.BITS) or (0,), directory.whole_numbers(tags.SAMPLE_FORMAT) or (UNSIGNED,)
    compression = _one(directory, tags.COMPRESSION) or 1  # 0 is written for none
    if compression not in DECODED:
        name = f"{COMPRESSIONS[compression]} (Compression {compression})" if compression in COMPRESSIONS else None
        raise ValueError(
            f"its picture is compressed by {name or f'the unknown method {compression}'}, not decoded here"
        )
    for tag, name in tags.INTERLEAVED.items():
        if (factors := directory.whole_numbers(tag)) and set(factors) != {1}:
            raise ValueError(f"its pixels are interleaved, which cannot be decoded ({name} {_listed(factors)})")
    if len(set(bits)) > 1:
        raise ValueError(f"its samples have different bits: {_listed(bits)}")
    if len(set(kinds)) > 1 or kinds[0] not in {UNSIGNED, FLOATING}:
        raise ValueError(f"its SampleFormat is {_listed(kinds)}, not 1 (unsigned) or 3 (floating-point)")
    floating = kinds[0] == FLOATING
    if not (bits[0] in {16, 24, 32} if floating else 1 <= bits[0] <= 16):
        kind, allowed = ("floating-point numbers", "16, 24 or 32") if floating else ("integers", "1 to 16")
        raise ValueError(f"its samples are {kind} of {bits[0]} bits, and those of {allowed} can be decoded")
    return bits[0], floating, compression


def _black(
    data: bytes, directory: Directory, first: Directory, samples: int
) -> tuple[list[list[tuple[float, ...]]], tuple[float, ...], tuple[float, ...]]:
    """Return the repeating black levels, and what columns and rows add to them."""
    source = directory if tags.BLACK_LEVEL in directory else first
    size = source.whole_numbers(tags.BLACK_REPEAT) if tags.BLACK_REPEAT in source else (1, 1)
    levels = source.get(tags.BLACK_LEVEL, (0,))
    if len(size) != 2 or min(size) < 1:
        raise ValueError(f"its BlackLevelRepeatDim is {_listed(size)}, not two numbers from 1")
    rows, columns = size
    if len(levels) == 1 and len(levels) != rows * columns * samples:
        rows, columns, levels = 1, 1, levels * samples
    if len(levels) != rows * columns * samples:
        of = f" of {samples} samples" if samples > 1 else ""
        raise ValueError(
            f"its BlackLevel has {len(levels)} values, its BlackLevelRepeatDim says {rows} x {columns}{of}"
        )
    deltas = source.long_values(data, tags.BLACK_COLUMNS), source.long_values(data, tags.BLACK_ROWS)
    for name, values in zip(("BlackLevel", "BlackLevelDeltaH", "BlackLevelDeltaV"), (levels, *deltas), strict=True):
        if not all(isinstance(value, int | float) and math.isfinite(value) for value in values):
            raise ValueError(f"its {name} holds a value that is not a finite number")
    pixels = [tuple(levels[i : i + samples]) for i in range(0, len(levels), samples)]
    return [pixels[i : i + columns] for i in range(0, len(pixels), columns)], *deltas


def _white(directory: Directory, samples: int, default: float) -> tuple[float, ...]:
    """Return the white level of each sample; 0 and none mean the default."""
    levels = directory.get(tags.WHITE_LEVEL, (default,))
    if len(set(levels)) == 1:
        levels = levels[:1] * samples
    if len(levels) != samples:
        raise ValueError(f"its WhiteLevel has {len(levels)} values for {samples} samples a pixel")
    if not all(isinstance(level, int | float) and 0 <= level < math.inf for level in levels):
        raise ValueError("its WhiteLevel holds a value that is not a positive number")
    return tuple(level or default for level in levels)


# ---------------------------------------------------------------------- colours


def _filter_array(directory: Directory) -> tuple[list[str], str]:
    """Return the letters of a filter array by rows, and those of its colour planes.

    Raises:
        ValueError: if its tags contradict each other.
    """
    pattern = directory.codes(tags.FILTER_PATTERN)
    if not pattern:
        raise ValueError("its CFAPattern is missing or cannot be read")
    size = directory.whole_numbers(tags.FILTER_REPEAT)
    rows, columns = size if len(size) == 2 else (0, 0)
    if not (0 < rows <= LARGEST_FILTER_TILE and 0 < columns <= LARGEST_FILTER_TILE):
        raise ValueError(f"its CFARepeatPatternDim is {_listed(size)}, not two numbers from 1 to {LARGEST_FILTER_TILE}")
    if len(pattern) != rows * columns:
        raise ValueError(f"its CFAPattern has {len(pattern)} entries, its CFARepeatPatternDim says {rows} x {columns}")
    colors = _plane_codes(directory)
    if beyond := sorted(set(pattern) - set(colors)):
        raise ValueError(f"its CFAPattern holds {_listed(beyond)}, which is not among its colours {_listed(colors)}")
    layout = directory.whole_numbers(tags.FILTER_LAYOUT) if tags.FILTER_LAYOUT in directory else (1,)
    if layout != (1,):
        raise ValueError(f"its CFALayout is {_listed(layout)}, and only 1, pixels in rows and columns, can be decoded")
    letters = _letters(pattern)
    return [letters[i : i + columns] for i in range(0, len(letters), columns)], _letters(colors)


def _plane_codes(directory: Directory) -> tuple[int, ...]:
    colors = directory.codes(tags.FILTER_COLORS) if tags.FILTER_COLORS in directory else (0, 1, 2)
    if not 0 < len(colors) == len(set(colors) & set(range(len(COLOR_LETTERS)))):
        last = len(COLOR_LETTERS) - 1
        raise ValueError(f"its CFAPlaneColor is {_listed(colors)}, not different colours from 0 to {last}")
    return colors


def _square_tile(rows: list[str], planes: str) -> tuple[tuple[str, ...] | None, str]:
    """Return the smallest square tile of a filter array that can be read, and its planes; None for one colour."""
    used = set("".join(rows))
    if len(used) == 1:
        return None, ""
    if len(used) not in {3, 4} or used != set(planes):
        raise ValueError(
            f"its filter array has the colours {' '.join(sorted(used))} of the planes {' '.join(planes)}, and only "
            "arrays of 3 or 4 colours, which are those of the planes, can be decoded"
        )
    tall = _period(rows)
    wide = _period(["".join(column) for column in zip(*rows, strict=True)])
    side = next((side for side in PERIODS if side % tall == 0 and side % wide == 0), None)
    if side is None:
        raise ValueError(
            f"its filter array repeats after {tall} x {wide} pixels, and only one that repeats after 2, 4 or 6 can be "
            "decoded"
        )
    return tuple("".join(rows[y % tall][x % wide] for x in range(side)) for y in range(side)), planes


def _period(lines: list[str]) -> int:
    return next(n for n in range(1, len(lines) + 1) if len(lines) % n == 0 and lines == lines[:n] * (len(lines) // n))


def _plane_names(directory: Directory, samples: int) -> str:
    """Return the letters of the planes of a linear picture; red, green and blue if the file does not name three."""
    planes = _letters(_plane_codes(directory))
    if samples not in {3, 4} or len(planes) != samples:
        raise ValueError(
            f"its linear picture has {samples} samples a pixel and the colours {' '.join(planes)}, and only one "
            "sample, or 3 or 4 of as many colours, can be decoded"
        )
    return planes


def _letters(codes: Sequence[int]) -> str:
    return "".join(COLOR_LETTERS[code] for code in codes)


def _one(directory: Directory, tag: int, default: int = 0) -> int:
    """Return the first integer value of a tag."""
    return (directory.whole_numbers(tag) or (default,))[0]


def _listed(numbers: Sequence[float]) -> str:
    shown = " ".join(map(str, numbers[:MOST_SHOWN])) or "empty"
    return shown + " ..." * (len(numbers) > MOST_SHOWN)
