"""A mosaic as a DNG file in memory: the form in which LibRaw takes counts that are not from a camera's file."""

from __future__ import annotations

import struct

import numpy as np

from kornia_tidy.sensor.raw_color import SRGB_FROM_XYZ

BYTE, SHORT, LONG, RATIONAL = 1, 3, 4, 10  # types of a TIFF field, with their struct codes below
CODES = {BYTE: "B", SHORT: "H", LONG: "I", RATIONAL: "i"}
COLOR_CODES = "RGBCMYW"  # a letter's place is its code in CFAPattern and CFAPlaneColor
DATA_ALIGNMENT = 16
MATRIX_UNIT = 1_000_000  # denominator of the colour matrix


def mosaic_dng(counts: np.ndarray, letters: str, to_srgb: np.ndarray | None = None) -> bytes:
    """Return an uncompressed DNG of counts behind a filter array, black 0 and white 65535.

    Args:
        counts: (H, W) uint16.
        letters: the tile by rows, 4 or 36 letters of R, G, B, C, M, Y.
        to_srgb: from R, G and B to linear sRGB, (3, 3). Default: they are those of sRGB. Other filters have no matrix.

    Source: Adobe, Digital Negative Specification 1.4; TIFF 6.0 for the container.
    """
    height, width = counts.shape
    side = int(len(letters) ** 0.5)
    fields = [
        (256, LONG, [width]),
        (257, LONG, [height]),
        (258, SHORT, [16]),  # bits a sample
        (259, SHORT, [1]),  # not compressed
        (262, SHORT, [32803]),  # a filter array
        (273, LONG, [0]),  # where the counts begin: known below
        (277, SHORT, [1]),  # samples a pixel
        (278, LONG, [height]),  # rows in the one strip
        (279, LONG, [counts.size * 2]),
        (33421, SHORT, [side, side]),
        (33422, BYTE, [COLOR_CODES.index(letter) for letter in letters]),
        (50706, BYTE, [1, 4, 0, 0]),  # version
        (50714, LONG, [0]),  # black
        (50717, LONG, [65535]),  # white
    ]
    if set(letters) == set("RGB"):
        from_xyz = np.linalg.inv(np.eye(3) if to_srgb is None else to_srgb) @ np.array(SRGB_FROM_XYZ)
        values = np.round(from_xyz * MATRIX_UNIT).astype(int).flatten().tolist()
        fields.append((50721, RATIONAL, [part for value in values for part in (value, MATRIX_UNIT)]))
    else:  # four colours, in LibRaw's order
        fields.insert(-2, (50710, BYTE, [COLOR_CODES.index(letter) for letter in "GMCY"]))

    packed = [struct.pack(f"<{len(numbers)}{CODES[kind]}", *numbers) for _, kind, numbers in fields]
    outside = 8 + 2 + 12 * len(fields) + 4  # values longer than four bytes follow the table
    begin = outside + sum(len(value) + len(value) % 2 for value in packed if len(value) > 4)
    begin = -(-begin // DATA_ALIGNMENT) * DATA_ALIGNMENT
    table, longer = struct.pack("<H", len(fields)), b""
    for (tag, kind, numbers), value in zip(fields, packed, strict=True):
        count = len(numbers) // (2 if kind == RATIONAL else 1)
        if tag == 273:
            content = struct.pack("<I", begin)
        elif len(value) <= 4:
            content = value.ljust(4, b"\0")
        else:
            content = struct.pack("<I", outside + len(longer))
            longer += value + b"\0" * (len(value) % 2)
        table += struct.pack("<HHI", tag, kind, count) + content
    head = struct.pack("<2sHI", b"II", 42, 8) + table + struct.pack("<I", 0) + longer
    return head.ljust(begin, b"\0") + counts.astype("<u2", copy=False).tobytes()
