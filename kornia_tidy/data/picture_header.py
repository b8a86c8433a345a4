"""Size and completeness of a picture file, checked before it is decoded.

Decoders allocate memory for the size in the header, and some fill missing parts with grey without an error. OpenCV
cannot read a header alone.

Source: PNG 1.2, sections 3 and 4.1; ITU-T T.81 (JPEG), annex B; Netpbm's ppm(5); Microsoft's
BITMAPINFOHEADER; RFC 9649 (WebP).
"""

from __future__ import annotations

import os
import re
import struct
import zlib
from collections.abc import Callable, Iterator
from typing import NamedTuple

PNG, JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"
LARGEST = 1 << 28  # pixels
VARIABLE = "KORNIA_TIDY_MAX_PIXELS"
FORMATS = "PNG, JPEG, TIFF, PGM, PPM, PFM, BMP, WebP or NPY"

_STARTS_OF_FRAME = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}  # tables, reserved, arithmetic conditioning
_START_OF_SCAN, _END = 0xDA, 0xD9
_ALONE = {0x01, *range(0xD0, 0xD9)}  # markers without a length: TEM, restarts and the start of the image
_NETPBM = re.compile(rb"P[1-6](?:\s|#[^\n]*\n)+(\d{1,10})(?:\s|#[^\n]*\n)+(\d{1,10})\s")

Size = tuple[int, int]
"""Rows and columns."""


def check_header(data: bytes) -> None:
    """Raise ``ValueError`` for a picture file of unknown format, cut short, or with too many pixels.

    Raises:
        ValueError: if the file is such.
    """
    for beginnings, size_of in _READERS:
        if data.startswith(beginnings):
            try:
                rows, columns = size_of(data)
            except (IndexError, struct.error):
                raise ValueError("the file is cut short") from None
            check_pixels("the picture", rows, columns)
            return
    raise ValueError(f"it is not an image in a known format: {FORMATS}")


def check_pixels(name: str, rows: int, columns: int) -> None:
    """Raise ``ValueError`` for a picture with too many pixels, before memory is allocated.

    The limit is 2^28 pixels (16384 x 16384), or the environment variable ``KORNIA_TIDY_MAX_PIXELS``.

    Raises:
        ValueError: if the size is beyond the limit.

    Example:
        >>> check_pixels("the scene", 10**6, 10**6)
        Traceback (most recent call last):
        ...
        ValueError: the scene has 1000000 x 1000000 pixels, more than 268435456: set KORNIA_TIDY_MAX_PIXELS to allow it
    """
    text = os.environ.get(VARIABLE, "")
    most = int(text) if text.isascii() and text.isdigit() else LARGEST
    if rows * columns > most:
        raise ValueError(f"{name} has {rows} x {columns} pixels, more than {most}: set {VARIABLE} to allow it")


def _png(data: bytes) -> Size:
    """Return the size of a PNG; raise ``ValueError`` unless all critical chunks are complete and undamaged."""
    last, size = b"", (0, 0)
    place = len(PNG)
    while last != b"IEND":
        length, last = struct.unpack_from(">I4s", data, place)
        end = place + 8 + length
        (sum_,) = struct.unpack_from(">I", data, end)
        critical = not last[0] & 0x20
        if critical and zlib.crc32(memoryview(data)[place + 4 : end]) != sum_:
            raise ValueError("the file is damaged: a check sum in it is wrong")
        if place == len(PNG):
            if last != b"IHDR":
                raise ValueError("the file is damaged: it does not begin with its size")
            columns, rows = struct.unpack_from(">II", data, place + 8)
            size = rows, columns
        place = end + 4
    return size


class JpegFrame(NamedTuple):
    """Header of a JPEG's frame."""

    process: int
    """0: baseline, 1: extended, 2: progressive, 3: lossless, and others; the number of the start of frame."""
    bits: int
    rows: int
    columns: int
    components: int


def jpeg_frame(data: bytes) -> JpegFrame:
    """Return the header of a JPEG's frame; raise ``ValueError`` unless an end marker follows the last start of a scan.

    Entropy-coded data cannot contain either marker.
    """
    frame, scan = None, None
    try:
        for marker, place in _segments(data):
            if marker in _STARTS_OF_FRAME and frame is None:
                frame = JpegFrame(marker - min(_STARTS_OF_FRAME), *struct.unpack_from(">BHHB", data, place + 4))
            if marker == _START_OF_SCAN:
                scan = place
    except struct.error:
        scan = None
    if frame is None or scan is None or data.rfind(b"\xff\xd9") < scan:
        raise ValueError("the file is cut short")
    return frame


def _jpeg(data: bytes) -> Size:
    frame = jpeg_frame(data)
    return frame.rows, frame.columns


def _segments(data: bytes) -> Iterator[tuple[int, int]]:
    """Yield each marker and its offset, up to the end of the image or of the file."""
    place = 2
    while (place := data.find(b"\xff", place)) >= 0 and place + 1 < len(data):
        marker = data[place + 1]
        if marker == _END:
            return
        if marker in {0x00, 0xFF} or marker in _ALONE:  # a data byte, a fill byte, or a marker without a length
            place += 1 if marker == 0xFF else 2
            continue
        yield marker, place
        place += 2 + struct.unpack_from(">H", data, place + 2)[0]


def _netpbm(data: bytes) -> Size:
    match = _NETPBM.match(data)
    if match is None:
        raise ValueError("it is not an image in a known format, or its header is damaged")
    return int(match[2]), int(match[1])


def _bmp(data: bytes) -> Size:
    form = "<HH" if struct.unpack_from("<I", data, 14)[0] == 12 else "<ii"
    columns, rows = struct.unpack_from(form, data, 18)
    return abs(rows), abs(columns)  # negative rows: stored from the top


def _webp(data: bytes) -> Size:
    """Return the size of a WebP in its three forms: extended, lossless and lossy."""
    kind = data[12:16]
    if data[8:12] != b"WEBP" or kind not in {b"VP8X", b"VP8L", b"VP8 "}:
        raise ValueError("it is not an image in a known format, or its header is damaged")
    if kind == b"VP8X":
        columns, rows = (int.from_bytes(data[place : place + 3], "little") + 1 for place in (24, 27))
    elif kind == b"VP8L":
        (bits,) = struct.unpack_from("<I", data, 21)
        columns, rows = (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    else:
        columns, rows = (side & 0x3FFF for side in struct.unpack_from("<HH", data, 26))
    return rows, columns


_READERS: tuple[tuple[tuple[bytes, ...], Callable[[bytes], Size]], ...] = (
    ((PNG,), _png),
    ((JPEG,), _jpeg),
    (tuple(b"P%d" % kind for kind in range(1, 7)), _netpbm),
    ((b"BM",), _bmp),
    ((b"RIFF",), _webp),
)
