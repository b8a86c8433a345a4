"""Transfer function of the numbers in a picture, as its file gives it: sRGB and its like, linear light, or HDR.

The numbers are not converted: whoever gives linear light to a camera says so by ``color_space="linear"``.

Source: PNG 3, section 11.3.2 (cICP, iCCP, sRGB, gAMA, and which of them counts); ICC.1:2022, sections 7.3, 10.3, 10.6
and 10.18, and annex B.4 for JPEG; ITU-T H.273, table 3; RFC 9649 (WebP).
"""

from __future__ import annotations

import os
import struct
from contextlib import suppress
from itertools import takewhile
from pathlib import Path

from kornia_tidy.data.picture_header import JPEG, PNG, jpeg_segments, png_chunks, unfolded, webp_chunks
from kornia_tidy.optics.units import warn_once

LINEAR_MIDDLE = 0.4  # light of the number 0.5: 0.5 if it is linear, 0.29 by a gamma of 1.8, 0.21 in sRGB
_LINEAR, _HDR = 8, {16: "PQ", 18: "HLG"}  # transfer characteristics of H.273
_APP2, _START_OF_SCAN, _ICC = 0xE2, 0xDA, b"ICC_PROFILE\0"
_CURVES = (b"gTRC", b"kTRC")


def is_linear(data: bytes) -> bool:
    """Return whether a PNG, JPEG or WebP file says that its numbers are linear light; damaged metadata say nothing.

    Args:
        data: bytes of the file.

    Raises:
        ValueError: if it says that they are encoded by PQ or HLG, or do not span the whole range.
    """
    if data.startswith(PNG):
        return _png(data)
    profile = b""
    with suppress(IndexError, struct.error):  # of a file that is cut short
        if data.startswith(JPEG):
            segments = takewhile(lambda segment: segment[0] != _START_OF_SCAN, jpeg_segments(data))
            places = [place for marker, place in segments if marker == _APP2]
            parts = [data[at + 4 : at + 2 + struct.unpack_from(">H", data, at + 2)[0]] for at in places]
            profile = b"".join(part[14:] for part in sorted(parts) if part.startswith(_ICC))  # by their numbers
        else:
            profile = next((data[begin:end] for kind, begin, end in webp_chunks(data) if kind == b"ICCP"), b"")
    return profile_is_linear(profile)


def profile_is_linear(profile: bytes) -> bool:
    """Return whether an ICC profile says that numbers are linear light; an empty or damaged one says nothing.

    Raises:
        ValueError: if it says that they are encoded by PQ or HLG.
    """
    with suppress(IndexError, struct.error, ArithmeticError):
        (count,) = struct.unpack_from(">I", profile, 128)
        entries = [struct.unpack_from(">4sII", profile, 132 + 12 * entry) for entry in range(min(count, 100))]
        tags = {name: profile[place : place + length] for name, place, length in entries}
        if b"cicp" in tags:
            return _characteristics(tags[b"cicp"][9])
        return any(_middle(tags[name]) > LINEAR_MIDDLE for name in _CURVES if name in tags)
    return False


def tell_linear(path: str | os.PathLike[str], linear: bool) -> None:
    """Warn, once for each folder and format, of a picture that holds linear light where sRGB is expected."""
    if linear:
        path = Path(path)
        warn_once(
            None,
            ("linear", path.parent, path.suffix),
            f"{path} says that its numbers are linear light, and they are taken for sRGB as they are: give "
            "color_space='linear' (--color-space linear), or save the picture in sRGB",
            stacklevel=4,
        )


def _png(data: bytes) -> bool:
    chunks: dict[bytes, bytes] = {}
    with suppress(IndexError, struct.error):
        for kind, begin, end in png_chunks(data):
            chunks.setdefault(kind, data[begin:end])
            if kind == b"IDAT":  # they stand before it
                break
        if b"cICP" in chunks:
            transfer, full = chunks[b"cICP"][1], chunks[b"cICP"][3]
            if not full:
                raise ValueError("its numbers do not span the whole range (cICP, as in video): save it in sRGB")
            return _characteristics(transfer)
        if b"iCCP" in chunks:
            return profile_is_linear(unfolded(chunks[b"iCCP"].partition(b"\0")[2][1:]))
        if b"gAMA" in chunks and b"sRGB" not in chunks:
            return 0.5 ** (1e5 / max(struct.unpack(">I", chunks[b"gAMA"])[0], 1)) > LINEAR_MIDDLE
    return False


def _characteristics(transfer: int) -> bool:
    """Return whether transfer characteristics of H.273 are linear; raise ``ValueError`` for those of HDR."""
    if transfer in _HDR:
        raise ValueError(
            f"its numbers are encoded by {_HDR[transfer]} (transfer characteristics {transfer}), and pictures here in "
            "sRGB: save it in sRGB with a view transform"
        )
    return transfer == _LINEAR


def _middle(curve: bytes) -> float:
    """Return the light of the number 0.5 by a curve of an ICC profile."""
    if curve.startswith(b"curv"):
        (count,) = struct.unpack_from(">I", curve, 8)
        if count == 0:
            return 0.5
        low, high = (struct.unpack_from(">H", curve, 12 + 2 * entry)[0] for entry in ((count - 1) // 2, count // 2))
        return 0.5 ** (low / 256) if count == 1 else (low + high) / 2 / 65535
    if curve.startswith(b"para"):
        (kind,) = struct.unpack_from(">H", curve, 8)
        gamma, a, b = (
            struct.unpack_from(">3i", curve, 12) if kind else (*struct.unpack_from(">i", curve, 12), 1 << 16, 0)
        )
        return (max(a / 2 + b, 0) / 65536) ** (gamma / 65536)
    return 0.0
