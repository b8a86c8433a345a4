"""DNG encoding from TIFF fields, with uncompressed 16-bit samples in one strip.

tifffile is not used: it writes extra tags, but no Exif directory, in which exposure, aperture and lens stand.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from fractions import Fraction

import numpy as np

from kornia_tidy.data.metadata import EXIF_POINTER, directory
from kornia_tidy.data.metadata import Field as ExifField

Field = tuple[int, int, Sequence[float] | bytes]  # tag, type, values

BYTE, ASCII, SHORT, LONG, RATIONAL, SRATIONAL = 1, 2, 3, 4, 5, 10  # types of TIFF 6.0
CODES = {BYTE: "B", SHORT: "H", LONG: "I"}
COLOR_CODES = "RGBCMYW"  # a letter's place is its code in CFAPattern and CFAPlaneColor
FILTER_ARRAY, LINEAR_RAW = 32803, 34892  # photometric interpretations
D65 = 21  # EXIF's light source
DATA_ALIGNMENT = 16
DENOMINATOR = 1_000_000  # largest of a rational number


def dng_bytes(
    samples: np.ndarray,
    letters: str | None,
    colors: str,
    white: int,
    fields: Sequence[Field] = (),
    exif: Sequence[ExifField] = (),
) -> bytes:
    """Encode samples and fields as the bytes of a DNG file.

    Args:
        samples: (H, W, C) uint16.
        letters: of the filter array's square tile, by rows; None without one.
        colors: the different letters in the order of the colour planes.
        white: saturation count.
        fields: further fields of the main directory.
        exif: fields of the Exif directory.

    Source: Adobe, Digital Negative Specification 1.4; TIFF 6.0 for the container.
    """
    height, width, channels = samples.shape
    samples = np.ascontiguousarray(samples, dtype="<u2")
    all_fields: list[Field] = [
        (254, LONG, [0]),  # the full picture
        (256, LONG, [width]),
        (257, LONG, [height]),
        (258, SHORT, [16] * channels),
        (259, SHORT, [1]),  # not compressed
        (262, SHORT, [LINEAR_RAW if letters is None else FILTER_ARRAY]),
        (277, SHORT, [channels]),
        (278, LONG, [height]),  # one strip
        (279, LONG, [samples.nbytes]),
        (284, SHORT, [1]),  # channels of a pixel together
        (50706, BYTE, [1, 4, 0, 0]),  # DNG version, and below it the oldest one that a reader must support
        (50707, BYTE, [1, 1, 0, 0]),
        (50717, LONG, [white] * channels),
        *fields,
    ]
    if letters is not None:
        side = round(len(letters) ** 0.5)
        all_fields += [
            (33421, SHORT, [side, side]),
            (33422, BYTE, [COLOR_CODES.index(letter) for letter in letters]),
            (50711, SHORT, [1]),  # pixels in rows and columns
        ]
    if letters is not None or len(colors) > 3:
        all_fields.append((50710, BYTE, [COLOR_CODES.index(letter) for letter in colors]))
    return b"".join(_tiff(all_fields, exif, samples.data.cast("B")))


def _tiff(fields: list[Field], exif: Sequence[ExifField], data: memoryview) -> tuple[bytes, memoryview]:
    """Encode a little-endian TIFF: header, directory, Exif directory, and the data of its one strip."""
    begin = 8
    fields = [*fields, (273, LONG, [0]), *([(EXIF_POINTER, LONG, [0])] if exif else [])]

    def table(places: dict[int, list[int]]) -> bytes:
        return directory([(tag, kind, *_packed(kind, places.get(tag, given))) for tag, kind, given in fields], begin)

    behind = begin + len(table({}))  # a first pass gives its size
    nested = directory(exif, behind) if exif else b""
    strip = -(-(behind + len(nested)) // DATA_ALIGNMENT) * DATA_ALIGNMENT
    head = struct.pack("<2sHI", b"II", 42, begin) + table({EXIF_POINTER: [behind], 273: [strip]}) + nested
    return head.ljust(strip, b"\0"), data


def _packed(kind: int, values: Sequence[float] | bytes) -> tuple[int, bytes]:
    """Encode values of a TIFF type; return their number and bytes."""
    if isinstance(values, bytes):
        return len(values) + 1, values + b"\0"
    if kind in CODES:
        return len(values), struct.pack(f"<{len(values)}{CODES[kind]}", *(int(value) for value in values))
    parts = [Fraction(value).limit_denominator(DENOMINATOR) for value in values]
    code = "I" if kind == RATIONAL else "i"
    return len(parts), b"".join(struct.pack(f"<2{code}", part.numerator, part.denominator) for part in parts)
