"""Size, completeness and kind of a picture file, checked before OpenCV decodes it.

Decoders allocate memory for the size in the header, and some fill missing parts with grey without an error. OpenCV
cannot read only a header. Kinds that it does not decode, or changes, are refused by their names.

Source: PNG 3, sections 5 and 11; ITU-T T.81 (JPEG), annex B; Microsoft's BITMAPINFOHEADER and BITMAPV4HEADER;
RFC 9649 (WebP).
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable, Iterator
from typing import NamedTuple

PNG, JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"
LARGEST = 1 << 28  # pixels
VARIABLE = "KORNIA_TIDY_MAX_PIXELS"
_LONGEST = 1 << 20  # bytes of a compressed text that are unfolded
FORMATS = "PNG, JPEG, TIFF, PBM, PGM, PPM, PAM, PFM, BMP, WebP, NPY or NPZ, and for depth OpenEXR or HDF5"

OTHERS = (
    (0, b"GIF8", "GIF"), (4, b"ftyphei", "HEIF"), (4, b"ftypmif1", "HEIF"), (4, b"ftypavi", "AVIF"),
    (4, b"ftyphev", "HEIF"), (4, b"ftypmsf1", "HEIF"), (0, b"CDF\1", "NetCDF 3"), (0, b"CDF\2", "NetCDF 3"),
    (0, b"\xff\x0a", "JPEG XL"), (4, b"JXL \r\n", "JPEG XL"), (4, b"jP  \r\n", "JPEG 2000"),
    (0, b"\xff\x4f\xff\x51", "JPEG 2000"), (0, b"#?R", "Radiance HDR"), (0, b"8BPS", "Photoshop"),
    (0, b"DDS ", "DDS"), (0, b"%PDF", "PDF"), (0, b"<svg", "SVG"), (0, b"<?xml", "XML"), (0, b"Ph", "a PFM of halves"),
    (0, b"PH", "a PFM of halves"), (0, b"PK\5\6", "an empty ZIP"), (0, b"SIMPLE  =", "FITS"), (0, b"MATLAB", "MATLAB"),
)  # fmt: skip
"""Kinds of files that are not read: where they begin, with what, and their name."""
RAW = (
    (0, b"FUJIFILM", "Fujifilm RAF"), (0, b"IIRO", "Olympus ORF"), (0, b"IIRS", "Olympus ORF"),
    (0, b"MMOR", "Olympus ORF"), (0, b"IIU\0", "Panasonic RW2"), (0, b"FOVb", "Sigma X3F"),
    (0, b"\0MRM", "Minolta MRW"), (4, b"ftypcrx ", "Canon CR3"), (6, b"HEAPCCDR", "Canon CRW"),
)  # fmt: skip
"""Camera raw files that are no TIFF, likewise."""

_STARTS_OF_FRAME = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}  # tables, reserved, arithmetic conditioning
_DECODED_PROCESSES = {0, 1, 2, 9, 10}  # baseline, extended and progressive, with either entropy coding
_START_OF_SCAN, _END = 0xDA, 0xD9
_ANIMATED = 0x02  # flag of an extended WebP
_BYTES = {0xFF << shift for shift in range(0, 32, 8)}  # masks of a BMP
_ALONE = {0x01, *range(0xD0, 0xD9)}  # markers without a length: TEM, restarts and the start of the image

Size = tuple[int, int]
"""Rows and columns."""


def check_header(data: bytes) -> None:
    """Raise ``ValueError`` for a picture file of unknown format or kind, cut short, or with too many pixels.

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
    if raw := next((name for place, beginning, name in RAW if data.startswith(beginning, place)), None):
        refuse_raw(raw)
    name = next((name for place, beginning, name in OTHERS if data.startswith(beginning, place)), None)
    raise ValueError(f"it is {f'{name}, ' if name else ''}not an image in a known format: {FORMATS}")


def refuse_raw(kind: str) -> None:
    """Raise ``ValueError`` for a camera raw file."""
    raise ValueError(f"it is a camera raw file ({kind}): develop it by kornia-tidy raw develop")


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
    text = os.environ.get(VARIABLE, "") or str(LARGEST)
    if not (text.isascii() and text.isdigit()):
        raise ValueError(f"{VARIABLE} must be a whole number of pixels, got {text!r:.80}")
    most = int(text)
    if rows * columns > most:
        raise ValueError(f"{name} has {rows} x {columns} pixels, more than {most}: set {VARIABLE} to allow it")


def png_chunks(data: bytes) -> Iterator[tuple[bytes, int, int]]:
    """Yield the kind of each chunk of a PNG, and where its data begin and end.

    Raises:
        IndexError, struct.error: if the file is cut short.
    """
    kind, place = b"", len(PNG)
    while kind != b"IEND":
        length, kind = struct.unpack_from(">I4s", data, place)
        yield kind, place + 8, place + 8 + length
        place += 12 + length


def unfolded(packed: bytes) -> bytes:
    """Return the beginning of a compressed text or profile in a PNG; empty if it is damaged."""
    try:
        return zlib.decompressobj().decompress(packed, _LONGEST)
    except zlib.error:
        return b""


def webp_chunks(data: bytes) -> Iterator[tuple[bytes, int, int]]:
    """Yield the kind of each chunk of a WebP, and where its data begin and end."""
    place = 12
    while data.startswith(b"RIFF") and place + 8 <= len(data):
        kind, length = struct.unpack_from("<4sI", data, place)
        yield kind, place + 8, place + 8 + length
        place += 8 + length + length % 2


def _png(data: bytes) -> Size:
    """Return the size of a PNG; raise ``ValueError`` unless all critical chunks are complete and undamaged."""
    size = None
    for kind, begin, end in png_chunks(data):
        (sum_,) = struct.unpack_from(">I", data, end)
        critical = not kind[0] & 0x20
        if critical and zlib.crc32(memoryview(data)[begin - 4 : end]) != sum_:
            raise ValueError("the file is damaged: a check sum in it is wrong")
        if size is None:
            if kind != b"IHDR":
                raise ValueError("the file is damaged: it does not begin with its size")
            columns, rows = struct.unpack_from(">II", data, begin)
            size = rows, columns
        if kind == b"acTL" and struct.unpack_from(">I", data, begin) > (1,):
            raise ValueError("it is an animated PNG, and one picture is read from a file")
    return size or (0, 0)


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
        for marker, place in jpeg_segments(data):
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
    """Return the size of a JPEG; raise ``ValueError`` for the kinds that OpenCV does not decode, or changes."""
    frame = jpeg_frame(data)
    if frame.process not in _DECODED_PROCESSES:
        raise ValueError(f"it is a lossless or hierarchical JPEG (SOF{frame.process}), which is not read")
    if frame.bits != 8:
        raise ValueError(f"it is a JPEG of {frame.bits} bits a sample, and read are those of 8")
    if frame.components not in {1, 3}:
        raise ValueError(f"it is a JPEG of {frame.components} components, such as CMYK, and read are grey and colour")
    return frame.rows, frame.columns


def jpeg_segments(data: bytes) -> Iterator[tuple[int, int]]:
    """Yield each marker of a JPEG and its offset, up to the end of the image or of the file.

    Raises:
        struct.error: if the file is cut short.
    """
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


def _bmp(data: bytes) -> Size:
    """Return the size of a BMP; refuse kinds with colours that OpenCV confuses."""
    (length,) = struct.unpack_from("<I", data, 14)
    columns, rows, _, bits = struct.unpack_from("<HHHH" if length == 12 else "<iiHH", data, 18)
    coding = 0 if length == 12 else struct.unpack_from("<I", data, 30)[0]
    if bits not in {0: (1, 4, 8, 24, 32), 1: (8,), 2: (4,), 3: (32,)}.get(coding, ()):
        raise ValueError(f"it is a BMP of {bits} bits a pixel with compression {coding}, which is not read")
    if coding == 3:
        masks = struct.unpack_from("<III", data, 54)
        if masks != (0xFF0000, 0xFF00, 0xFF) and (length < 56 or any(mask not in _BYTES for mask in masks)):
            raise ValueError("it is a BMP whose colours lie in other bits than usual, which is not read")
    return abs(rows), abs(columns)  # negative rows: stored from the top


def _webp(data: bytes) -> Size:
    """Return the size of a WebP in its three forms: extended, lossless and lossy."""
    kind = data[12:16]
    if data[8:12] != b"WEBP" or kind not in {b"VP8X", b"VP8L", b"VP8 "}:
        raise ValueError("it is not an image in a known format, or its header is damaged")
    if kind == b"VP8X":
        if data[20] & _ANIMATED:
            raise ValueError("it is an animated WebP, and one picture is read from a file")
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
    ((b"BM",), _bmp),
    ((b"RIFF",), _webp),
)
