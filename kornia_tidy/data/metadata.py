"""Metadata in picture files: camera and exposure as EXIF, and texts in a PNG.

OpenCV writes EXIF from a block that is encoded already, from version 4.12 on, and no texts.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Mapping, Sequence
from datetime import datetime
from fractions import Fraction
from typing import Any

from kornia_tidy.data.picture_header import JPEG, PNG
from kornia_tidy.data.tiff_directories import Directory

ASCII, SHORT, LONG, RATIONAL, UNDEFINED = 2, 3, 4, 5, 7  # types of TIFF fields
SIZES = {1: 1, ASCII: 1, SHORT: 2, LONG: 4, RATIONAL: 8, 6: 1, UNDEFINED: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8}  # bytes
EXIF_POINTER = 0x8769
TIFF = b"II*\0"

Field = tuple[int, int, int, bytes]
"""Tag, type, number of values, and the bytes of the values."""


def with_exif(file: bytes, info: Mapping[str, Any]) -> bytes:
    """Return a PNG, JPEG or TIFF file with EXIF added; the picture is not changed.

    Args:
        file: bytes of a file without EXIF.
        info: any of ``make``, ``model``, ``lens`` (texts), ``exposure`` (seconds), ``aperture`` (f-number), ``iso``,
            ``focal_length`` (metres), ``timestamp`` (a datetime); None and other names are left out.

    Returns:
        The file, unchanged if ``info`` has none of these.

    Raises:
        ValueError: if it has another format, or is a big-endian TIFF.

    Source: CIPA DC-008, Exif 2.32, section 4.6; PNG 1.2 extensions 1.5 (``eXIf``); JPEG's APP1; TIFF 6.0, section 2.
    """
    picture, photo = exif_fields(info)
    if not photo:
        return file
    if file.startswith(PNG):
        return _with_chunk(file, b"eXIf", _exif_block(picture, photo))
    if file.startswith(JPEG):
        block = b"Exif\0\0" + _exif_block(picture, photo)
        return file[:2] + b"\xff\xe1" + struct.pack(">H", len(block) + 2) + block + file[2:]
    if file.startswith(TIFF):
        return _with_directories(file, picture, photo)
    raise ValueError("EXIF is written into PNG, JPEG and little-endian TIFF files, this is none")


def with_text(png: bytes, texts: Mapping[str, str]) -> bytes:
    """Return a PNG file with texts added by keyword, in Latin-1.

    Source: PNG specification, 11.3.4.3 (``tEXt``).
    """
    for keyword, text in texts.items():
        png = _with_chunk(png, b"tEXt", keyword.encode("latin-1") + b"\0" + text.encode("latin-1", "replace"))
    return png


def exif_fields(info: Mapping[str, Any]) -> tuple[list[Field], list[Field]]:
    """Return the fields of the picture's directory and of its EXIF directory; both are empty without metadata."""

    def known(name: str) -> Any:
        return info.get(name)

    def positive(name: str) -> float | None:
        value = known(name)
        return value if value is not None and 0 < value < math.inf else None

    picture = [_text(tag, known(name)) for tag, name in ((0x010F, "make"), (0x0110, "model")) if known(name)]
    photo: list[Field] = []
    for tag, name, unit in ((0x829A, "exposure", 1), (0x829D, "aperture", 1), (0x920A, "focal_length", 1000)):
        if (value := positive(name)) is not None:
            photo.append((tag, RATIONAL, 1, _rational(value * unit)))
    if (iso := positive("iso")) is not None:
        photo.append((0x8827, SHORT, 1, struct.pack("<H", min(round(iso), 65535))))
    if isinstance(known("timestamp"), datetime):
        photo.append(_text(0x9003, known("timestamp").strftime("%Y:%m:%d %H:%M:%S")))
    if known("lens"):
        photo.append(_text(0xA434, known("lens")))
    if picture or photo:
        photo.append((0x9000, UNDEFINED, 4, b"0232"))
    return picture, sorted(photo)


def _text(tag: int, text: str) -> Field:
    data = text.encode("ascii", "replace") + b"\0"
    return tag, ASCII, len(data), data


def _rational(value: float) -> bytes:
    fraction = Fraction(min(value, 2**31)).limit_denominator(10**6)
    scale = max(1, -(-fraction.numerator // (2**32 - 1)))
    return struct.pack("<II", fraction.numerator // scale, max(1, fraction.denominator // scale))


def _exif_block(picture: list[Field], photo: list[Field]) -> bytes:
    """Return a TIFF file without a picture: header, directory, EXIF directory."""
    pointer: Field = (EXIF_POINTER, LONG, 1, b"\0\0\0\0")
    behind = 8 + len(directory([*picture, pointer], 8))
    first = directory([*picture, (EXIF_POINTER, LONG, 1, struct.pack("<I", behind))], 8)
    return TIFF + struct.pack("<I", 8) + first + directory(photo, behind)


def _with_directories(file: bytes, picture: list[Field], photo: list[Field]) -> bytes:
    """Return a TIFF file with a second, extended directory appended; the data it refers to stay in place."""
    (place,) = struct.unpack_from("<I", file, 4)
    fields: list[Field] = []
    for tag, (kind, number, begins) in Directory(file, place).fields.items():
        size = SIZES[kind] * number
        begin = begins if size <= 4 else struct.unpack_from("<I", file, begins)[0]
        fields.append((tag, kind, number, file[begin : begin + size]))
    file += b"\0" * (len(file) % 2)
    exif = directory(photo, len(file))
    pointer: Field = (EXIF_POINTER, LONG, 1, struct.pack("<I", len(file)))
    place = len(file) + len(exif)
    return file[:4] + struct.pack("<I", place) + file[8:] + exif + directory([*fields, *picture, pointer], place)


def directory(fields: Sequence[Field], place: int) -> bytes:
    """Return the bytes of a directory at an offset of the file, followed by its values longer than four bytes."""
    behind = place + 2 + 12 * len(fields) + 4
    table, longer = struct.pack("<H", len(fields)), b""
    for tag, kind, number, data in sorted(fields):
        content = data.ljust(4, b"\0") if len(data) <= 4 else struct.pack("<I", behind + len(longer))
        table += struct.pack("<HHI", tag, kind, number) + content
        longer += data + b"\0" * (len(data) % 2) if len(data) > 4 else b""
    return table + struct.pack("<I", 0) + longer


def _with_chunk(png: bytes, kind: bytes, data: bytes) -> bytes:
    """Return a PNG file with a chunk inserted after its signature (8 bytes) and header (25 bytes)."""
    chunk = struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
    return png[:33] + chunk + png[33:]
