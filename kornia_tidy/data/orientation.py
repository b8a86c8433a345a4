"""Orientation of photographs in EXIF and XMP, and the warning that it is not applied.

Programs that estimate depth from a photograph usually rotate it upright before. Their depth does not fit the stored
pixels. Where both have the same size, only the orientation shows it.
"""

from __future__ import annotations

import os
import re
import struct
from collections.abc import Iterator
from contextlib import suppress
from operator import itemgetter
from pathlib import Path
from typing import Literal

from kornia_tidy.data.picture_header import JPEG, PNG, jpeg_segments, png_chunks, unfolded, webp_chunks
from kornia_tidy.data.tiff_directories import Directory
from kornia_tidy.optics.units import warn_once

STORED = {
    2: ("mirrored left to right", "depth[:, ::-1]"),
    3: ("rotated by 180 degrees", "depth[::-1, ::-1]"),
    4: ("mirrored top to bottom", "depth[::-1]"),
    5: ("mirrored along its diagonal", "depth.T"),
    6: ("rotated by 90 degrees anticlockwise", "np.rot90(depth)"),
    7: ("mirrored along its other diagonal", "depth[::-1, ::-1].T"),
    8: ("rotated by 90 degrees clockwise", "np.rot90(depth, -1)"),
}
"""How a picture of each orientation is stored, and what brings an upright map (H, W) into the same form."""

_TAG = 0x0112
_APP1, _START_OF_SCAN = 0xE1, 0xDA
_EXIF, _XMP = b"Exif\0\0", b"ns.adobe.com/xap/1.0/\0"
_XMP_TURN = re.compile(rb"""tiff:Orientation(?:\s*=\s*["']|>)\s*([1-8])\s*[<"']""")


def orientation_of(data: bytes) -> int:
    """Return the orientation of a PNG, JPEG or WebP file, 1 to 8; 1 if it tells of none.

    EXIF goes before XMP, and damaged metadata tell of none.

    Args:
        data: bytes of the file.

    Source: CIPA DC-008, Exif 2.32, section 4.6.4; Adobe XMP specification, part 3; RFC 9649; PNG 3, 11.3.4.5.
    """
    blocks = _png if data.startswith(PNG) else _jpeg if data.startswith(JPEG) else _webp
    found = []
    with suppress(IndexError, struct.error):  # of a file that is cut short
        found += [turn for block in blocks(data) if (turn := _turn(block))]
    return min(found, key=itemgetter(0), default=(0, 1))[1]


def tell_orientation(
    path: str | os.PathLike[str], orientation: int, size: tuple[int, ...], of: Literal["picture", "depth"]
) -> None:
    """Warn, once for each folder, format, size and orientation, that the orientation of a file is not applied.

    Args:
        path: the file.
        orientation: 1 to 8; 1 gives no warning.
        size: rows and columns.
        of: content of the file.

    Warns:
        UserWarning: with the operation that makes the other file of a scene fit.
    """
    if orientation in STORED:
        path = Path(path)
        key = ("orientation", path.parent, path.suffix, size, orientation, of)
        warn_once(None, key, told(path, orientation, of), stacklevel=4)


def told(path: str | os.PathLike[str], orientation: int, of: Literal["picture", "depth"] = "picture") -> str:
    """Return the warning about a file with another orientation than 1.

    Example:
        >>> told("lamp.jpg", 3)
        'lamp.jpg is stored rotated by 180 degrees (orientation 3) and is read as it is stored: if its depth was made \
from the upright picture, as viewers show it, bring the depth into the same form with depth[::-1, ::-1], or save the \
picture upright'
    """
    how, _ = STORED[orientation]
    begin = f"{path} is stored {how} (orientation {orientation}) and is read as it is stored: if its "
    if of == "depth":
        upright = STORED[{6: 8, 8: 6}.get(orientation, orientation)][1]
        return begin + f"picture is upright, as viewers show it, bring the depth into the same form with {upright}"
    return begin + (
        f"depth was made from the upright picture, as viewers show it, bring the depth into the same form with "
        f"{STORED[orientation][1]}, or save the picture upright"
    )


def _turn(block: bytes) -> tuple[int, int] | None:
    """Return the rank and the orientation in a block of EXIF (rank 0) or XMP (rank 1), if there is one."""
    block = block.removeprefix(_EXIF)
    if block[:4] not in {b"II*\0", b"MM\0*"}:
        match = _XMP_TURN.search(block)
        return (1, int(match[1])) if match else None
    with suppress(ValueError):
        turn = Directory(block, int.from_bytes(block[4:8], "little" if block[:2] == b"II" else "big")).number(_TAG, 0)
        return (0, turn) if 1 <= turn <= 8 else None
    return None


def _jpeg(data: bytes) -> Iterator[bytes]:
    for marker, place in jpeg_segments(data):
        if marker == _START_OF_SCAN:
            return
        block = data[place + 4 : place + 2 + int.from_bytes(data[place + 2 : place + 4], "big")]
        if marker == _APP1 and (block.startswith(_EXIF) or _XMP in block[:40]):
            yield block


def _png(data: bytes) -> Iterator[bytes]:
    for kind, begin, end in png_chunks(data):
        if kind == b"eXIf":
            yield data[begin:end]
        elif kind in {b"tEXt", b"zTXt", b"iTXt"}:
            keyword, _, text = data[begin:end].partition(b"\0")
            if keyword == b"XML:com.adobe.xmp":
                yield text
            elif keyword in {b"Raw profile type exif", b"Raw profile type APP1", b"Raw profile type xmp"}:
                yield _profile(unfolded(text[1:]) if kind == b"zTXt" else text)


def _profile(text: bytes) -> bytes:
    """Return the bytes of a profile as ImageMagick writes it: name, length and hexadecimal digits."""
    try:
        return bytes.fromhex(b"".join(text.split()[2:]).decode("ascii"))
    except ValueError:
        return b""


def _webp(data: bytes) -> Iterator[bytes]:
    return (data[begin:end] for kind, begin, end in webp_chunks(data) if kind in {b"EXIF", b"XMP "})
