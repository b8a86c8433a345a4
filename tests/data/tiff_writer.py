"""A writer of TIFF files with any properties, for the tests: every field and byte is made here, by no library's writer.

Source: TIFF 6.0, sections 2, 9, 13 to 15; the BigTIFF file format proposal; Adobe Photoshop TIFF Technical Note 3
(floating-point predictor).
"""

from __future__ import annotations

import lzma
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import imagecodecs
import numpy as np

FORMS = {1: "B", 2: "B", 3: "H", 4: "I", 5: "I", 6: "b", 7: "B", 8: "h", 9: "i", 10: "i", 11: "f", 12: "d", 13: "I",
         16: "Q", 17: "q", 18: "Q"}  # fmt: skip
LZW_CODES = 4094
PACKBITS = 32773

Field = tuple[int, Sequence[Any] | bytes]
"""Type and values; None in place of it leaves a field out."""


@dataclass
class Page:
    """A picture and how it is stored."""

    values: np.ndarray
    """(H, W, C), integers of any width in a wider type, or floats."""
    bits: int = 8
    format: int = 1
    photometric: int = 1
    extra: tuple[int, ...] | None = None
    separate: bool = False
    compression: int = 1
    predictor: int = 1
    reversed_bits: bool = False
    tile: tuple[int, int] | None = None
    rows_per_strip: int | None = None
    """None: one strip, without the field."""
    segments: list[bytes] | None = None
    """Bytes of strips or tiles, in place of those of the values."""
    filled: bool = False
    """Whether the last strip has as many rows as the others."""
    fields: dict[int, Field | None] = field(default_factory=dict)
    """Further fields, or others in place of those made here."""
    below: list[Page] = field(default_factory=list)
    """Pages of subdirectories."""


def tiff(*pages: Page, order: str = "<", big: bool = False) -> bytes:
    """Return a file of pages, which follow each other."""
    head = {"<": b"II", ">": b"MM"}[order] + struct.pack(f"{order}H", 43 if big else 42)
    head += struct.pack(f"{order}HH", 8, 0) if big else b""
    body = _Body(head + bytes(8 if big else 4), order, big)
    link = len(head)
    for page in pages:
        place, following = body.directory(page)
        body.write(link, "Q" if big else "I", place)
        link = following
    return bytes(body.data)


class _Body:
    def __init__(self, data: bytes, order: str, big: bool) -> None:
        self.data, self.order, self.big = bytearray(data), order, big
        self.offset, self.kind = ("Q", 16) if big else ("I", 4)

    def write(self, place: int, form: str, *values: Any) -> None:
        struct.pack_into(self.order + form, self.data, place, *values)

    def append(self, data: bytes) -> int:
        """Append at an even place, which is returned."""
        self.data += bytes(len(self.data) % 2)
        self.data += data
        return len(self.data) - len(data)

    def directory(self, page: Page) -> tuple[int, int]:
        """Append a page; return the places of its directory and of the link to the next one."""
        below = [self.directory(other)[0] for other in page.below]
        coded = encoded(page, self.order) if page.segments is None else page.segments
        places = [self.append(part) if part else 0 for part in coded]
        rows, columns, samples = page.values.shape
        of_tiles = page.tile is not None
        fields: dict[int, Field | None] = {
            256: (4, [columns]), 257: (4, [rows]), 258: (3, [page.bits] * samples), 259: (3, [page.compression]),
            262: (3, [page.photometric]), 324 if of_tiles else 273: (self.kind, places), 277: (3, [samples]),
            325 if of_tiles else 279: (self.kind, [len(part) for part in coded]), 284: (3, [1 + page.separate]),
            339: (3, [page.format] * samples),
        }  # fmt: skip
        if page.tile is not None:
            fields |= {322: (3, [page.tile[1]]), 323: (3, [page.tile[0]])}
        elif page.rows_per_strip is not None:
            fields[278] = 4, [page.rows_per_strip]
        if page.extra is not None:
            fields[338] = 3, page.extra
        if page.reversed_bits:
            fields[266] = 3, [2]
        if page.predictor != 1:
            fields[317] = 3, [page.predictor]
        if below:
            fields[330] = 13, below
        entries = b""
        for tag, content in sorted((fields | page.fields).items()):
            if content is None:
                continue
            kind, values = content
            form = f"{len(values)}{FORMS[kind]}"
            packed = struct.pack(self.order + form, *values)
            count = len(values) // (2 if kind in {5, 10} else 1)
            room = struct.calcsize(self.offset)
            inline = packed.ljust(room, b"\0") if len(packed) <= room else b""
            inline = inline or struct.pack(self.order + self.offset, self.append(packed))
            entries += struct.pack(f"{self.order}HH{self.offset}", tag, kind, count) + inline
        number = struct.pack(self.order + ("Q" if self.big else "H"), len(entries) // (20 if self.big else 12))
        place = self.append(number + entries + bytes(struct.calcsize(self.offset)))
        return place, len(self.data) - struct.calcsize(self.offset)


def encoded(page: Page, order: str) -> list[bytes]:
    """Return the bytes of each strip or tile."""
    rows, columns, samples = page.values.shape
    high = page.tile[0] if page.tile else min(page.rows_per_strip or rows, rows)
    wide = page.tile[1] if page.tile else columns
    planes = [page.values[..., [s]] for s in range(samples)] if page.separate else [page.values]
    parts = []
    for plane in planes:
        for row in range(0, rows, high):
            for column in range(0, columns, wide):
                part = plane[row : row + high, column : column + wide]
                full = high if page.tile or page.filled else len(part)
                surplus = ((0, full - len(part)), (0, wide - part.shape[1]), (0, 0))
                packed = packed_rows(np.pad(part, surplus, mode="edge"), page, order)
                parts.append(compressed(packed, page.compression, page.reversed_bits, full))
    return parts


def packed_rows(values: np.ndarray, page: Page, order: str) -> bytes:
    """Return the bytes of rows of samples, with the predictor applied."""
    rows, columns, samples = values.shape
    bits = page.bits
    if page.format == 3 and bits == 24:  # sign, 7 bits of exponent, 16 of mantissa
        wide = values.astype("<f4").view("<u4").astype(np.int64)
        exponent = np.where(wide & 0x7FFFFFFF, (wide >> 23 & 0xFF) - 127 + 63, 0)
        values = (wide >> 31) << 23 | exponent << 16 | (wide & 0x7FFFFF) >> 7
    if bits not in {8, 16, 32, 64}:
        numbers = values.astype(np.int64).reshape(rows, -1) & (2**bits - 1)
        if bits == 24:
            lines = numbers.astype(order + "u4").view("u1").reshape(rows, -1, 4)
            return (lines[..., :3] if order == "<" else lines[..., 1:]).tobytes()
        ones = (numbers[..., None] >> np.arange(bits - 1, -1, -1)) & 1
        return np.packbits(ones.reshape(rows, -1).astype(np.uint8), axis=1).tobytes()
    letter = "f" if page.format == 3 and bits > 8 else "i" if page.format == 2 else "u"
    kind = np.dtype(f"{order}{letter}{bits // 8}")
    stored = values.astype(kind)
    if page.predictor == 2:
        numbers = stored.view(f"{order}u{bits // 8}").astype(np.uint64)
        numbers[:, 1:] -= numbers[:, :-1].copy()
        stored = (numbers & np.uint64(2**bits - 1)).astype(f"{order}u{bits // 8}")
    if page.predictor == 3:
        size = bits // 8
        lines = stored.astype(kind.newbyteorder(">")).view("u1").reshape(rows, columns * samples, size)
        lines = lines.transpose(0, 2, 1).reshape(rows, -1).astype(np.int16)
        lines[:, samples:] -= lines[:, :-samples].copy()
        return (lines & 0xFF).astype(np.uint8).tobytes()
    return stored.tobytes()


def compressed(data: bytes, compression: int, reversed_bits: bool, rows: int) -> bytes:
    """Compress a strip or tile."""
    coders = {1: bytes, 5: lzw, 8: zlib.compress, 32946: zlib.compress, PACKBITS: packbits,
              34925: lambda raw: lzma.compress(raw, lzma.FORMAT_XZ, lzma.CHECK_NONE),
              50000: imagecodecs.zstd_encode}  # fmt: skip
    coded = coders.get(compression, bytes)(data)
    if compression == PACKBITS:  # each row by itself
        size = len(data) // rows
        coded = b"".join(packbits(data[row * size :][:size]) for row in range(rows))
    if reversed_bits:
        return np.packbits(np.unpackbits(np.frombuffer(coded, np.uint8)), bitorder="little").tobytes()
    return coded


def packbits(data: bytes) -> bytes:
    """Compress a row by PackBits: runs of equal bytes, and other bytes as they are."""
    coded, place = bytearray(), 0
    while place < len(data):
        run = 1
        while run < 128 and data[place : place + run + 1] == data[place : place + 1] * (run + 1):
            run += 1
        if run > 1:
            coded += bytes((257 - run, data[place]))
            place += run
            continue
        end = place + 1
        while end < len(data) and end - place < 128 and data[end : end + 1] * 2 != data[end : end + 2]:
            end += 1
        coded += bytes((end - place - 1,)) + data[place:end]
        place = end
    return bytes(coded)


def lzw(data: bytes, old: bool = False) -> bytes:
    """Compress by LZW; old: with the bits the other way round and longer codes one later, as before TIFF 6.0."""
    codes: list[tuple[int, int]] = []
    table, width = {bytes((value,)): value for value in range(256)}, 9
    later = 0 if old else 1
    codes.append((256, width))
    following = 258
    known = b""
    for value in data:
        longer = known + bytes((value,))
        if longer in table:
            known = longer
            continue
        codes.append((table[known], width))
        table[longer] = following
        following += 1
        if following + later > 1 << width and width < 12:
            width += 1
        if following >= LZW_CODES:
            codes.append((256, width))
            table, width, following = {bytes((value,)): value for value in range(256)}, 9, 258
        known = bytes((value,))
    if known:
        codes.append((table[known], width))
        following += 1
        if following + later > 1 << width and width < 12:
            width += 1
    codes.append((257, width))
    if old:
        number = shift = 0
        for code, size in codes:
            number |= code << shift
            shift += size
        return number.to_bytes(-(-shift // 8), "little")
    ones = "".join(f"{code:0{size}b}" for code, size in codes)
    return int(ones.ljust(-(-len(ones) // 8) * 8, "0"), 2).to_bytes(-(-len(ones) // 8), "big")
