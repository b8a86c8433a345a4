"""A small DNG, uncompressed and in one strip, so that what a raw file may say can be tested without a camera."""

from __future__ import annotations

import struct
from fractions import Fraction

import numpy as np

BYTE, ASCII, SHORT, LONG, RATIONAL, UNDEFINED, SRATIONAL, DOUBLE = 1, 2, 3, 4, 5, 7, 10, 12
LETTERS = {1: "B", 3: "H", 4: "I", 5: "I", 10: "i", 12: "d"}
XTRANS = "GGRGGBGGBGGRBRGRBGGGBGGRGGRGGBRBGBRG"


def dng(counts, pattern="RGGB", black=(64,), white=1023, order="<", **more):
    """Return the bytes of a DNG of counts (H, W) behind a filter array, or (H, W, 3), linear, with pattern None.

    More: black_repeat, orientation, active_area, matrix, neutral, extra (tags by number: type and values); blocks (the
    bytes of the strips, or with tiles=True of the tiles) and gaps (bytes before each) instead of one strip.
    """
    height, width = counts.shape[:2]
    channels = 1 if counts.ndim == 2 else counts.shape[2]
    side = 0 if pattern is None else int(len(pattern) ** 0.5)
    blocks = more.get("blocks") or [counts.astype(order + "u2").tobytes()]
    gaps = more.get("gaps", [0] * len(blocks))
    offsets, lengths = (324, 325) if more.get("tiles") else (273, 279)
    tags = {
        254: (LONG, [0]),
        256: (LONG, [width]),
        257: (LONG, [height]),
        258: (SHORT, [16] * channels),
        259: (SHORT, [1]),
        262: (SHORT, [34892 if pattern is None else 32803]),
        271: (ASCII, b"Maker\0"),
        272: (ASCII, b"Model One\0"),
        274: (SHORT, [more.get("orientation", 1)]),
        277: (SHORT, [channels]),
        278: (LONG, [height]),
        50706: (BYTE, [1, 4, 0, 0]),
        50707: (BYTE, [1, 4, 0, 0]),
        50708: (ASCII, b"Maker Model One\0"),
        50713: (SHORT, list(more.get("black_repeat", (1, 1)))),
        50714: (LONG, list(black)),
        50717: (LONG, [white] * channels),
        50721: (SRATIONAL, more.get("matrix", np.eye(3).ravel().tolist())),
        50728: (RATIONAL, more.get("neutral", [0.5, 1.0, 0.625])),
        50778: (SHORT, [21]),
        offsets: (LONG, [0] * len(blocks)),
        lengths: (LONG, list(map(len, blocks))),
        **more.get("extra", {}),
    }
    tags = {tag: field for tag, field in tags.items() if field is not None}
    if pattern is not None:
        tags.setdefault(33421, (SHORT, [side, side]))
        tags.setdefault(33422, (BYTE, ["RGBCMYW".index(letter) for letter in pattern]))
    if "active_area" in more:
        tags[50829] = (LONG, list(more["active_area"]))
    exif = {34855: (SHORT, [400]), 33434: (RATIONAL, [0.04]), 33437: (RATIONAL, [2.8]), 37386: (RATIONAL, [35])}
    exif |= {36867: (ASCII, b"2024:02:29 12:34:56\0"), 42036: (ASCII, b"Prime 35\0")}
    tags[34665] = (LONG, [0])
    start = 8 + _size(tags)
    tags[34665] = (LONG, [start])
    places = [start + _size(exif) + gaps[0]]
    for block, gap in zip(blocks, gaps[1:], strict=False):
        places.append(places[-1] + len(block) + gap)
    tags[offsets] = (LONG, places)
    data = b"".join(bytes(gap) + block for gap, block in zip(gaps, blocks, strict=True))
    head = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "I", 8)
    return head + _directory(tags, 8, order) + _directory(exif, start, order) + data


def _pack(kind, values, order):
    if kind in {ASCII, UNDEFINED}:
        return values
    if kind in {RATIONAL, SRATIONAL}:
        parts = [Fraction(value).limit_denominator(10**6) for value in values]
        values = [number for part in parts for number in (part.numerator, part.denominator)]
    return struct.pack(f"{order}{len(values)}{LETTERS[kind]}", *values)


def _size(tags):
    long = [len(_pack(*tag, "<")) for tag in tags.values()]
    return 6 + 12 * len(tags) + sum(size + size % 2 for size in long if size > 4)


def _directory(tags, offset, order):
    entries, data = b"", b""
    place = offset + 6 + 12 * len(tags)
    for tag, (kind, values) in sorted(tags.items()):
        packed = _pack(kind, values, order)
        entries += struct.pack(order + "HHI", tag, kind, len(values))
        if len(packed) <= 4:
            entries += packed.ljust(4, b"\0")
        else:
            entries += struct.pack(order + "I", place + len(data))
            data += packed + b"\0" * (len(packed) % 2)
    return struct.pack(order + "H", len(tags)) + entries + struct.pack(order + "I", 0) + data


def patched(data, which, **changes):
    """Return a file of ours with a tag of its first directory changed: tag, kind, number or, of 4 bytes, value."""
    data = bytearray(data)
    start, count = 10, struct.unpack_from("<H", data, 8)[0]
    place = next(p for p in range(start, start + 12 * count, 12) if struct.unpack_from("<H", data, p)[0] == which)
    old = dict(zip(("tag", "kind", "number", "value"), struct.unpack_from("<HHI4s", data, place), strict=True))
    struct.pack_into("<HHI4s", data, place, *(old | changes).values())
    return bytes(data)
