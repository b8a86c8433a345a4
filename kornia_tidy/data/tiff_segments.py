"""Decoding of the strips or tiles of a TIFF to one array.

tifffile decodes each strip or tile. It sees a directory that is made here of checked fields, so that none of its
parsers of metadata runs. Nothing is allocated that the compressed bytes cannot fill.

Source: TIFF 6.0, sections 3, 8 to 11, 13 to 15 and 22; Adobe Photoshop TIFF Technical Notes (Deflate, predictor 3).
"""

from __future__ import annotations

import io
import logging
import struct
from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kornia_tidy.data.picture_header import check_pixels, jpeg_frame
from kornia_tidy.data.tiff_directories import COLUMNS, COMPRESSION, PHOTOMETRIC, ROWS, SAMPLES, Directory
from kornia_tidy.search_path import import_installed

BITS, FILL_ORDER, STRIP_OFFSETS, ROWS_PER_STRIP, STRIP_BYTES, PLANES, T4_OPTIONS = 258, 266, 273, 278, 279, 284, 292
PREDICTOR, TILE_COLUMNS, TILE_ROWS, TILE_OFFSETS, TILE_BYTES, SAMPLE_FORMAT = 317, 322, 323, 324, 325, 339
JPEG_TABLES, DEPTH, TILE_DEPTH = 347, 32997, 32998

MOST_SAMPLES = 4
MOST_SEGMENTS = 1 << 18
JPEG, CCITT = 7, (2, 3, 4)
UNFOLDS = {1: 1, 2: 1 << 16, 3: 1 << 16, 4: 1 << 16, 5: 1 << 12, 7: 1 << 11, 8: 1 << 11, 32773: 64, 32946: 1 << 11,
           34925: 1 << 14, 50000: 1 << 16}  # fmt: skip
"""Compressions that are read, and the most bytes that one byte can unfold to."""
_RGB, _YCBCR = 2, 6  # photometric interpretations
_JPEG_PROCESSES = (0, 1, 2)  # baseline, extended, progressive
_PREDICTED = (5, 8, 32946, 34925, 50000)  # compressions that may come with a predictor
_FORMATS = {1: "unsigned integers", 2: "signed integers", 3: "floating-point numbers", 4: "values of undefined meaning",
            5: "complex integers", 6: "complex numbers"}  # fmt: skip
_WIDTHS = {1: {*range(1, 33), 64} - {24}, 2: {8, 16, 32, 64}, 3: {16, 32, 64}}  # bits that are read, by format


class Layout(NamedTuple):
    """How the samples of a picture are stored."""

    rows: int
    columns: int
    samples: int
    """Of a pixel."""
    bits: int
    """Of a sample."""
    format: int
    """1: unsigned, 2: signed, 3: floating-point."""
    compression: int
    planes: int
    """1, or the number of samples where each has strips or tiles of its own."""
    segment: tuple[int, int]
    """Rows and columns of a strip or tile."""
    tiled: bool

    @property
    def dtype(self) -> np.dtype[Any]:
        """The smallest data type that holds a sample."""
        size = next(size for size in (1, 2, 4, 8) if 8 * size >= self.bits)
        return np.dtype(f"{' uif'[self.format]}{size}")


def layout_of(directory: Directory) -> Layout:
    """Return how the samples of a picture are stored.

    Raises:
        ValueError: if they are stored in a way that is not read, or the directory is damaged.
    """
    rows, columns = directory.number(ROWS, 0), directory.number(COLUMNS, 0)
    check_pixels("the picture", rows, columns)
    samples = directory.number(SAMPLES, 1)
    if min(rows, columns, samples) < 1:
        raise ValueError(f"the file is damaged: it has {rows} x {columns} pixels of {samples} samples")
    if samples > MOST_SAMPLES:
        raise ValueError(f"it has {samples} samples a pixel, more than {MOST_SAMPLES}")
    for tag in (DEPTH, TILE_DEPTH):
        if (depth := directory.number(tag, 1)) > 1:
            raise ValueError(f"it is a volume of {depth} slices (ImageDepth), not a picture")
    bits, kind = _same(directory, BITS, samples, "bits"), _same(directory, SAMPLE_FORMAT, samples, "SampleFormat")
    if bits not in _WIDTHS.get(kind, ()):
        what = _FORMATS.get(kind, "values of an unknown kind")
        raise ValueError(f"its samples are {bits}-bit {what} (SampleFormat {kind}), which are not read")
    compression = _compression(directory, bits, kind)
    planes = 1
    if samples > 1 and (planes := directory.number(PLANES, 1)) not in {1, 2}:
        raise ValueError(f"the file is damaged: its PlanarConfiguration is {planes}, neither 1 nor 2")
    tiled = TILE_COLUMNS in directory
    if tiled:
        segment = directory.number(TILE_ROWS, 0), directory.number(TILE_COLUMNS, 0)
        across, down = -(-columns // max(segment[1], 1)), -(-rows // max(segment[0], 1))
        check_pixels("the picture in whole tiles", down * segment[0], across * segment[1])
    else:
        segment = min(directory.number(ROWS_PER_STRIP, rows), rows), columns
    if min(segment) < 1:
        raise ValueError(f"the file is damaged: its strips or tiles have {segment[0]} x {segment[1]} pixels")
    return Layout(rows, columns, samples, bits, kind, compression, samples if planes == 2 else 1, segment, tiled)


def decode_segments(
    data: bytes, directory: Directory, layout: Layout, fill: float | None = None
) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
    """Decode the samples of a picture.

    Args:
        data: the file.
        directory: of the picture.
        layout: of its samples, from :func:`layout_of`.
        fill: value of pixels in strips or tiles that the file leaves out; None: it must leave out none.

    Returns:
        (rows, columns, samples), and (rows, columns) True where strips or tiles are left out; None: nowhere.

    Raises:
        ValueError: if the file is damaged, or leaves out strips or tiles that it must not.
    """
    name, places = "tile" if layout.tiled else "strip", _places(layout)
    extents = _extents(data, directory, layout, name, places)
    if fill is None and (absent := [number for number, (_, size) in enumerate(extents) if not size]):
        raise ValueError(f"{name} {absent[0] + 1} of {len(places)} is left out of it: its length is 0")
    dtype, pixels = layout.dtype, None
    missing = np.zeros((layout.rows, layout.columns), bool) if fill is not None else None
    decode = _decoder(directory, layout, data)
    for number, ((plane, row, column, high), (offset, size)) in enumerate(zip(places, extents, strict=True)):
        area = slice(row, row + high), slice(column, column + layout.segment[1])
        if not size and missing is not None:
            missing[area] = True
            continue
        coded, title = data[offset : offset + size], f"{name} {number + 1} of {len(places)}"
        rows = high if layout.compression != JPEG else _jpeg_rows(coded, high, layout, title)
        try:
            segment = decode(coded, rows)[:high]
            if segment.dtype != dtype:
                raise ValueError(f"it holds {segment.dtype}")
        except MemoryError:
            raise
        except Exception as error:
            raise ValueError(f"the file is damaged: {title} ({error!s:.100})") from None
        if len(places) == 1:
            return segment[: layout.rows, : layout.columns], None
        if pixels is None:
            shape = (layout.rows, layout.columns, layout.samples)
            pixels = np.empty(shape, dtype) if missing is None else np.full(shape, fill, dtype)
        target = pixels[(*area, slice(plane, plane + 1) if layout.planes > 1 else slice(None))]
        target[...] = segment[: target.shape[0], : target.shape[1]]
    if pixels is None:
        raise ValueError(f"all of its {name}s are left out of it")
    return pixels, missing


def _same(directory: Directory, tag: int, samples: int, name: str) -> int:
    """Return the value of a field that all samples share."""
    values = directory.numbers(tag)[:samples].tolist() or [1]
    if len({*values}) > 1:
        raise ValueError(f"its samples differ: {name} are {', '.join(map(str, values))}")
    return values[0]


def _compression(directory: Directory, bits: int, kind: int) -> int:
    """Return the compression; raise ``ValueError`` unless it is read, for these samples and with this predictor."""
    compression, predictor = directory.number(COMPRESSION, 1), directory.number(PREDICTOR, 1)
    if compression not in UNFOLDS:
        raise ValueError(f"its compression is {compression} ({named('COMPRESSION', compression)}), not read")
    if compression != 1:
        try:
            _tifffile().TIFF.DECOMPRESSORS[compression]
        except KeyError:
            said = f"its compression is {compression}: that needs newer packages (pip install -U tifffile imagecodecs)"
            raise ValueError(said) from None
    if (compression in CCITT and (bits, kind) != (1, 1)) or (compression == JPEG and (bits, kind) != (8, 1)):
        what = f"{bits}-bit {_FORMATS[kind]}"
        raise ValueError(f"its compression is {compression} with {what}: JPEG is read of 8 bits, CCITT of 1 bit")
    if predictor != 1 and compression not in {JPEG, *CCITT}:
        if compression not in _PREDICTED:
            raise ValueError(f"its predictor is {predictor} with compression {compression}, which has none")
        if predictor not in {2, 3} or bits not in {8, 16, 32, 64} or (predictor == 3 and kind != 3):
            raise ValueError(f"its predictor is {predictor} for {bits}-bit {_FORMATS[kind]}, which is not read")
    if (order := directory.number(FILL_ORDER, 1)) not in {1, 2}:
        raise ValueError(f"the file is damaged: its FillOrder is {order}, neither 1 nor 2")
    return compression


def _places(layout: Layout) -> list[tuple[int, int, int, int]]:
    """Return plane, first row, first column and number of rows of each strip or tile."""
    high, wide = layout.segment
    count = layout.planes * -(-layout.rows // high) * -(-layout.columns // wide)
    if count > MOST_SEGMENTS:
        raise ValueError(f"it has {count} strips or tiles, more than {MOST_SEGMENTS}")
    return [
        (plane, row, column, high if layout.tiled else min(high, layout.rows - row))
        for plane in range(layout.planes)
        for row in range(0, layout.rows, high)
        for column in range(0, layout.columns, wide)
    ]


def _extents(
    data: bytes, directory: Directory, layout: Layout, name: str, places: list[tuple[int, int, int, int]]
) -> list[tuple[int, int]]:
    """Return offset and length of each strip or tile; a length of 0 where it is left out.

    Raises:
        ValueError: if they lie beyond the end of the file or over each other, or are too short for their pixels.
    """
    of_tiles = TILE_OFFSETS in directory
    offsets, sizes = (
        directory.numbers(tag) for tag in ((TILE_OFFSETS, TILE_BYTES) if of_tiles else (STRIP_OFFSETS, STRIP_BYTES))
    )
    sizes = sizes if len(sizes) else len(data) - offsets  # left out by some old programs
    if min(len(offsets), len(sizes)) < len(places):
        raise ValueError(f"the file is damaged: it has {len(places)} {name}s, and {len(offsets)} offsets")
    offsets, sizes = offsets[: len(places)], sizes[: len(places)]
    line = -(-layout.segment[1] * layout.bits * (1 if layout.planes > 1 else layout.samples) // 8)  # bytes
    needed = line * np.array([rows for *_, rows in places])
    if layout.compression == 1:
        sizes = np.minimum(sizes, needed)
    sizes = np.where(offsets == 0, 0, sizes)
    if (offsets < 0).any() or (sizes < 0).any() or (offsets + sizes > len(data)).any():
        raise ValueError(f"the file is cut short: a {name} reaches beyond its end")
    if sizes.sum() > len(data):
        raise ValueError(f"the file is damaged: its {name}s lie over each other")
    short = (sizes > 0) & (sizes * UNFOLDS[layout.compression] < needed)
    if short.any():
        worst = int(short.argmax())
        raise ValueError(
            f"the file is cut short or damaged: {name} {worst + 1} of {len(places)} has {sizes[worst]} bytes, too few"
        )
    return list(zip(offsets.tolist(), sizes.tolist(), strict=True))


def _decoder(directory: Directory, layout: Layout, data: bytes) -> Callable[[bytes, int], NDArray[Any]]:
    """Return what decodes the bytes of a strip or tile with some rows to (rows, columns, samples)."""
    tables = directory.numbers(JPEG_TABLES).astype(np.uint8).tobytes() or None
    decoders: dict[int, Callable[..., Any]] = {}

    def decode_rows(segment: bytes, rows: int) -> NDArray[Any]:
        if rows not in decoders:
            decoders[rows] = _tifffile_decoder(directory, layout, rows, segment)
        decoded = decoders[rows](segment, 0, jpegtables=tables)[0][0]
        return decoded.view(np.uint8) if decoded.dtype == bool else decoded

    def decode(segment: bytes, rows: int) -> NDArray[Any]:
        try:
            return decode_rows(segment, rows)
        except Exception:
            if rows == layout.segment[0]:
                raise
            return decode_rows(segment, layout.segment[0])  # some programs fill up the last strip

    return decode


def _jpeg_rows(coded: bytes, high: int, layout: Layout, title: str) -> int:
    """Return the rows of a JPEG that is a strip or tile: as many as the strip shows, or as others have.

    Raises:
        ValueError: if it is of another size or kind.
    """
    try:
        frame = jpeg_frame(coded)
    except ValueError:
        raise ValueError(f"the file is cut short or damaged: {title} is no whole JPEG") from None
    if frame.process not in _JPEG_PROCESSES or frame.bits != layout.bits:
        raise ValueError(f"its JPEG is of process {frame.process} and {frame.bits} bits: 0, 1 or 2 and 8 bits are read")
    if frame.columns != layout.segment[1] or frame.rows not in {high, layout.segment[0]}:
        raise ValueError(f"the file is damaged: {title} is a JPEG of {frame.rows} x {frame.columns} pixels")
    return frame.rows


def named(kind: str, value: int) -> str:
    """Return the name that an enumeration of tifffile has for a value."""
    names = getattr(_tifffile(), kind)
    return names(value).name if value in set(names) else "unknown"


@cache
def _tifffile() -> Any:
    """Import tifffile on first use. Its log goes only to handlers that a program has set."""
    logging.getLogger("tifffile").addHandler(logging.NullHandler())
    return import_installed("tifffile")


def _tifffile_decoder(directory: Directory, layout: Layout, rows: int, first: bytes) -> Callable[..., Any]:
    """Return tifffile's decoder of strips or tiles with some rows."""
    tifffile = _tifffile()

    samples = layout.samples if layout.planes == 1 else 1
    # JPEG's colours are converted if they are called YCbCr, or called RGB with a JFIF header, which says otherwise.
    given = directory.number(PHOTOMETRIC, _RGB)
    photometric = given if given == _YCBCR else _RGB
    head = first[:16] if given == _RGB else b""
    fields = {
        COLUMNS: [layout.segment[1]], ROWS: [rows], BITS: [layout.bits] * samples, COMPRESSION: [layout.compression],
        PHOTOMETRIC: [photometric if layout.compression == JPEG and samples == 3 else 1],
        FILL_ORDER: [directory.number(FILL_ORDER, 1)], STRIP_OFFSETS: [0], SAMPLES: [samples], ROWS_PER_STRIP: [rows],
        STRIP_BYTES: [len(head)], PLANES: [1], T4_OPTIONS: [directory.number(T4_OPTIONS, 0)],
        PREDICTOR: [directory.number(PREDICTOR, 1)] if layout.compression in _PREDICTED else [1],
        SAMPLE_FORMAT: [layout.format] * samples,
    }  # fmt: skip
    order = directory.order
    values = 8 + 2 + 12 * len(fields) + 4  # behind the directory
    fields[STRIP_OFFSETS] = [values + 4 * sum(len(numbers) for numbers in fields.values())]
    entries = behind = b""
    for tag, numbers in fields.items():
        packed = struct.pack(f"{order}{len(numbers)}I", *numbers)
        entries += struct.pack(f"{order}HHI", tag, 4, len(numbers))
        entries += packed if len(numbers) == 1 else struct.pack(f"{order}I", values + len(behind))
        behind += packed
    start = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(f"{order}IH", 8, len(fields))
    return tifffile.TiffFile(io.BytesIO(start + entries + bytes(4) + behind + head)).pages.first.decode
