"""Directories of a TIFF: the fields of each, and which one describes the picture.

tifffile does not read them: it parses the metadata of many vendors at the same time, without bounds.

Source: TIFF 6.0, section 2; Adobe PageMaker 6.0 TIFF Technical Notes (subdirectories); the BigTIFF file format
proposal; DNG 1.7 (NewSubfileType).
"""

from __future__ import annotations

import math
import re
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kornia_tidy.data.picture_header import refuse_raw

MAGIC = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")

NEW_SUBFILE_TYPE, SUBFILE_TYPE, COLUMNS, ROWS, COMPRESSION, PHOTOMETRIC, SAMPLES = 254, 255, 256, 257, 259, 262, 277
DESCRIPTION, SUB_DIRECTORIES, CFA_PATTERN, META_MORPH, DNG_VERSION = 270, 330, 33422, 33629, 50706

MOST_DIRECTORIES = 1000
MOST_FIELDS = 1024
_MOST_BYTES = 1 << 16  # bytes
_KINDS = {1: "u1", 2: "u1", 3: "u2", 4: "u4", 6: "i1", 7: "u1", 8: "i2", 9: "i4", 13: "u4", 16: "u8", 17: "i8",
          18: "u8"}  # fmt: skip
_LARGEST = 1 << 62  # for unsigned numbers of 64 bits: beyond any file
_REDUCED, _MASK = 1, 4  # bits of NewSubfileType
_OLD_REDUCED = 2  # SubfileType
_TRANSPARENCY_MASK, _RAW_PHOTOMETRIC = 4, (32803, 34892)  # CFA, LinearRaw
_RAW_COMPRESSION = (32767, 32769, 32770, 34713, 65535)  # Sony, packed, Samsung, Nikon, Pentax
_IMAGEJ = re.compile(rb"ImageJ=[^\n]{0,40}\nimages=(\d{1,9})\n")
_TIFFFILE = re.compile(rb'\{"shape": \[([\d, ]{1,99})\][^{}]{0,999}"truncated": true')


class Directory:
    """Fields of one directory, by number. Values are read when they are asked for."""

    def __init__(self, data: bytes, place: int) -> None:
        self.data, self.order = data, "<" if data[:2] == b"II" else ">"
        self.big = b"+" in data[:4]
        if place < (16 if self.big else 8):
            raise ValueError(f"the file is damaged: a directory begins at byte {place}, in its header")
        count, place = *self._unpack("Q" if self.big else "H", place), place + (8 if self.big else 2)
        if not 0 < count <= MOST_FIELDS:
            raise ValueError(f"the file is damaged: a directory has {count} fields, not 1 to {MOST_FIELDS}")
        size = 20 if self.big else 12
        self.fields: dict[int, tuple[int, int, int]] = {}
        """Type, number of values, and place of the value or of its offset; of two fields with one number the first."""
        for entry in range(place, place + count * size, size):
            tag, kind, number = self._unpack("HHQ" if self.big else "HHI", entry)
            self.fields.setdefault(tag, (kind, number, entry + (12 if self.big else 8)))
        (self.next,) = self._unpack("Q" if self.big else "I", place + count * size)

    def __contains__(self, tag: int) -> bool:
        return tag in self.fields

    def numbers(self, tag: int) -> NDArray[np.int64]:
        """Return the whole numbers of a field, none if the field is missing.

        Raises:
            ValueError: if it has other values, or they reach beyond the end of the file.
        """
        if tag not in self.fields:
            return np.empty(0, np.int64)
        kind, number, place = self.fields[tag]
        if kind not in _KINDS:
            raise ValueError(f"the file is damaged: field {tag} holds no whole numbers")
        dtype = np.dtype(self.order + _KINDS[kind])
        if number * dtype.itemsize > (8 if self.big else 4):
            (place,) = self._unpack("Q" if self.big else "I", place)
        if place + number * dtype.itemsize > len(self.data):
            raise ValueError(f"the file is cut short: field {tag} reaches beyond its end")
        numbers = np.frombuffer(self.data, dtype, number, place)
        return (np.minimum(numbers, _LARGEST) if dtype.kind == "u" and dtype.itemsize == 8 else numbers).astype(
            np.int64
        )

    def number(self, tag: int, default: int) -> int:
        """Return the first whole number of a field, or the default if it is missing or empty."""
        numbers = self.numbers(tag)
        return int(numbers[0]) if len(numbers) else default

    def stored_bytes(self, tag: int) -> bytes:
        """Return the beginning of a field of bytes; empty if it is missing or of another type."""
        kind, number, place = self.fields.get(tag, (0, 0, 0))
        if _KINDS.get(kind) != "u1":
            return b""
        if number > (8 if self.big else 4):
            (place,) = self._unpack("Q" if self.big else "I", place)
        return self.data[place : place + min(number, _MOST_BYTES)]

    def text(self, tag: int) -> bytes:
        """Return the beginning of a text, up to its first zero byte; empty if it is missing."""
        return self.stored_bytes(tag).split(b"\0")[0]

    @property
    def reduced(self) -> bool:
        """Whether it is a preview with fewer pixels than another picture of the file."""
        return bool(self.number(NEW_SUBFILE_TYPE, 0) & _REDUCED) or self.number(SUBFILE_TYPE, 0) == _OLD_REDUCED

    @property
    def pixels(self) -> int:
        """Number of pixels."""
        return self.number(ROWS, 0) * self.number(COLUMNS, 0)

    @property
    def mask(self) -> bool:
        """Whether it says which pixels of another picture are valid."""
        marked = bool(self.number(NEW_SUBFILE_TYPE, 0) & _MASK)
        return marked or self.number(PHOTOMETRIC, 1) == _TRANSPARENCY_MASK

    def _unpack(self, form: str, place: int) -> tuple[Any, ...]:
        if place + struct.calcsize("=" + form) > len(self.data):
            raise ValueError("the file is cut short: a directory reaches beyond its end")
        return struct.unpack_from(self.order + form, self.data, place)


def picture_directories(data: bytes) -> tuple[Directory, Directory | None]:
    """Return the directory of the only picture in a TIFF, and that of its mask of valid pixels if it has one.

    Reduced-resolution previews are passed over. Pictures in subdirectories count where all directories are previews,
    and where they are larger: some cameras leave their preview unmarked.

    Raises:
        ValueError: if the file is damaged, holds several pictures or none, or is a camera raw file.
    """
    big = b"+" in data[:4]
    form, place = ("<" if data[:2] == b"II" else ">") + ("HHQ" if big else "I"), 4
    if len(data) < place + struct.calcsize(form):
        raise ValueError("the file is cut short: its header is not complete")
    *sizes, first = struct.unpack_from(form, data, place)
    if sizes not in ([], [8, 0]):
        raise ValueError(f"the file is damaged: its BigTIFF header gives offsets of {sizes[0]} bytes, not 8")
    chain = _chain(data, first, [])
    if data[8:10] == b"CR" and not big:
        refuse_raw("Canon CR2")
    for directory in chain:
        _check_raw(directory)
    whole = _pictures(chain)
    try:
        below = _below(data, chain)
    except ValueError:  # what is damaged beside a picture does not matter
        if not whole:
            raise
        below = []
    for directory in below:
        _check_raw(directory)
    whole += [found for found in _pictures(below) if not whole or found.pixels > whole[0].pixels]
    if not whole:
        what = "transparency mask" if all(directory.mask for directory in chain) else "reduced-resolution preview"
        fault = f"NewSubfileType {chain[0].number(NEW_SUBFILE_TYPE, 0)}"
        raise ValueError(f"it holds only a {what} ({fault}); of a camera raw file: kornia-tidy raw develop")
    if len(whole) > 1:
        _refuse_stack(len(whole))
    picture = whole[0]
    if (stacked := _stacked(picture)) > 1:
        _refuse_stack(stacked)
    size = [picture.number(tag, 0) for tag in (ROWS, COLUMNS)]
    masks = [d for d in chain if d.mask and not d.reduced and [d.number(tag, 0) for tag in (ROWS, COLUMNS)] == size]
    return picture, masks[0] if masks else None


def _pictures(directories: list[Directory]) -> list[Directory]:
    return [directory for directory in directories if not directory.reduced and not directory.mask]


def _chain(data: bytes, place: int, others: list[Directory]) -> list[Directory]:
    """Return a directory and those that follow it."""
    chain: list[Directory] = []
    seen: set[int] = set()
    while place:
        if place in seen:
            raise ValueError("the file is damaged: its directories follow each other in a circle")
        if len(chain) + len(others) == MOST_DIRECTORIES:
            raise ValueError(f"it holds more than {MOST_DIRECTORIES} pages: save the one that is meant in its own file")
        seen.add(place)
        chain.append(Directory(data, place))
        place = chain[-1].next
    if not chain and not others:
        raise ValueError("the file is damaged: it has no directory")
    return chain


def _below(data: bytes, chain: list[Directory]) -> list[Directory]:
    """Return the subdirectories of some directories."""
    below: list[Directory] = []
    for directory in chain:
        for place in directory.numbers(SUB_DIRECTORIES)[:MOST_DIRECTORIES]:
            below += _chain(data, int(place), below)
    return below


def _stacked(picture: Directory) -> int:
    """Return the number of pictures that lie behind each other under one directory, as programs of microscopes do."""
    if META_MORPH in picture:
        return picture.fields[META_MORPH][1]  # its number of values is that of the planes
    description = picture.text(DESCRIPTION)
    if found := _IMAGEJ.match(description):
        return int(found[1])
    if found := _TIFFFILE.match(description):
        size = math.prod(picture.number(tag, 1) for tag in (ROWS, COLUMNS, SAMPLES))
        return math.prod(int(side) for side in found[1].split(b",") if side.strip()) // max(size, 1)
    return 1


def _check_raw(directory: Directory) -> None:
    for tag, name in ((DNG_VERSION, "DNG"), (CFA_PATTERN, "with a colour filter array")):
        if tag in directory:
            refuse_raw(name)
    for tag, values, name in (
        (PHOTOMETRIC, _RAW_PHOTOMETRIC, "photometric interpretation"),
        (COMPRESSION, _RAW_COMPRESSION, "compression"),
    ):
        if (value := directory.number(tag, 1)) in values:
            refuse_raw(f"{name} {value}")


def _refuse_stack(count: int) -> None:
    raise ValueError(f"it holds {count} pictures (pages): save the one that is meant in its own file")
