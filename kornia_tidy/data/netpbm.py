"""Netpbm files: PBM, PGM and PPM, plain and raw, and PAM.

OpenCV's reader is not used: it ignores the maximum of raw files, multiplies plain ones by 255 / maximum, and takes
samples above the maximum.
"""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kornia_tidy.data.picture_header import check_pixels

MAGICS = tuple(b"P%d" % kind for kind in range(1, 8))
LARGEST = 65535  # of samples

_BLANKS = b" \t\n\v\f\r"
_NUMBER = re.compile(rb"(?:[ \t\n\v\f\r]|#[^\r\n]*+[\r\n])++(\d{1,10})(?=[ \t\n\v\f\r#])")
_COMMENT = re.compile(rb"#[^\r\n]*")
_TUPLES = {b"BLACKANDWHITE": 1, b"GRAYSCALE": 1, b"RGB": 3}  # channels; one more with the ending _ALPHA
_SIZES = (b"HEIGHT", b"WIDTH", b"DEPTH", b"MAXVAL")

Shape = tuple[int, int, int]
"""Rows, columns and channels."""


def decode_netpbm(data: bytes, depth: bool = False) -> tuple[NDArray[Any], int, NDArray[np.bool_] | None]:
    r"""Decode a PBM, PGM, PPM or PAM file of one picture.

    Args:
        data: bytes of the file.
        depth: whether depth is wanted and not a picture.

    Returns:
        The stored samples, (H, W, C) uint8 or uint16, without alpha; the maximum, which means white; and of depth with
        alpha (H, W), True where it is transparent, else None.

    Raises:
        ValueError: if the header is damaged, the picture too large, the file cut short or longer than its picture, a
            sample above the maximum, or the meaning of the channels of a PAM file unknown.

    Convention:
        In a bitmap (PBM) a bit 1 is black. It is returned as 0 and the other as 1, the maximum, as PAM has them.

    Source: Netpbm's pbm(5), pgm(5), ppm(5) and pam(5).

    Example:
        >>> values, white, _ = decode_netpbm(b"P2 3 1 # a comment\n15  0 5 15")
        >>> values[..., 0], white
        (array([[ 0,  5, 15]], dtype=uint8), 15)
    """
    shape, white, colours, end = _pam_header(data) if data.startswith(b"P7") else _header(data)
    check_pixels("the picture", *shape[:2])
    if not 1 <= white <= LARGEST:
        raise ValueError(f"its maximum must be 1 to {LARGEST}, it is {white}")
    bitmap = data[:2] in {b"P1", b"P4"}
    if data[:2] in {b"P1", b"P2", b"P3"}:
        values = _plain_samples(data[end:], shape, bitmap)
    else:
        values = _raw_samples(data, end, shape, white, bitmap)
    if (largest := values.max(initial=0)) > white:
        raise ValueError(f"it holds {largest:.10g}, more than the maximum {white} in its header")
    unknown = values[..., colours] == 0 if depth and shape[2] > colours == 1 else None
    values = values.astype(np.uint8 if white < 256 else np.uint16)[..., :colours]
    return (1 - values if bitmap else values), white, unknown


def _header(data: bytes) -> tuple[Shape, int, int, int]:
    """Return the shape, the maximum, the number of grey or colour channels, and the offset behind the last number."""
    channels, found, end = 3 if data[:2] in {b"P3", b"P6"} else 1, [], 2
    for _ in range(2 if data[:2] in {b"P1", b"P4"} else 3):
        match = _NUMBER.match(data, end)
        if match is None:
            raise ValueError("its Netpbm header is cut short or damaged: columns, rows and maximum are whole numbers")
        found.append(int(match[1]))
        end = match.end()
    columns, rows, white = (*found, 1)[:3]
    return (rows, columns, channels), white, channels, end


def _pam_header(data: bytes) -> tuple[Shape, int, int, int]:
    """Return shape, maximum, grey or colour channels and the offset behind the header of a PAM file."""
    found: dict[bytes, int] = {}
    kinds = []
    name, end = b"", data.find(b"\n")
    if data[2 : max(end, 2)].strip():
        raise ValueError("its first line is not that of a PAM file, 'P7'")
    while name != b"ENDHDR":
        begin, end = end, data.find(b"\n", end + 1)
        if end < 0 or begin < 0:
            raise ValueError("its PAM header is cut short: it ends with a line 'ENDHDR'")
        line = data[begin:end].strip()
        name, value = (*line.split(None, 1), b"", b"")[:2]
        if name == b"TUPLTYPE":
            kinds.append(value)
        elif name in _SIZES and name not in found and re.fullmatch(rb"\d{1,10}", value):
            found[name] = int(value)
        elif name not in {b"", b"ENDHDR"} and not name.startswith(b"#"):
            raise ValueError(f"its PAM header has the line {line[:40].decode('ascii', 'replace')!r}")
    if len(found) < len(_SIZES):
        raise ValueError("its PAM header must give WIDTH, HEIGHT, DEPTH and MAXVAL")
    rows, columns, channels, white = (found[name] for name in _SIZES)
    return (rows, columns, channels), white, _colours(b" ".join(kinds), channels), end


def _colours(kind: bytes, channels: int) -> int:
    """Return how many of the channels of a PAM file are grey or colours; a fourth or second may be alpha."""
    colours = _TUPLES.get(kind.removesuffix(b"_ALPHA"))
    if colours is not None and channels == colours + kind.endswith(b"_ALPHA"):
        return colours
    if channels == 1 or (channels == 3 and not kind):
        return channels
    name = repr(kind[:40].decode("ascii", "replace")) if kind else "missing"
    raise ValueError(f"the meaning of its {channels} channels is unknown: its TUPLTYPE is {name}")


def _raw_samples(data: bytes, end: int, shape: Shape, white: int, bitmap: bool) -> NDArray[Any]:
    rows, columns, channels = shape
    line = -(-columns // 8) if bitmap else columns * channels * (1 if white < 256 else 2)  # bytes
    start = end + 1  # a single blank separates header and samples
    doubled = data[end : end + 2] == b"\r\n"
    if (comment := _COMMENT.match(data, end)) is not None:  # its end takes the place of the blank, or precedes it
        start = comment.end() + 1
        doubled = data[start : start + 1].isspace()
    start += doubled and len(data) - start == rows * line + 1
    _check_length(len(data) - start, rows * line, data[start + rows * line :], "bytes")
    if bitmap:
        packed = np.frombuffer(data, np.uint8, rows * line, start).reshape(rows, line)
        return np.unpackbits(packed, axis=1, count=columns)[..., None]
    kind = np.dtype(np.uint8 if white < 256 else ">u2")
    return np.frombuffer(data, kind, math.prod(shape), start).reshape(shape)


def _plain_samples(text: bytes, shape: Shape, bitmap: bool) -> NDArray[Any]:
    if b"#" in text:
        text = _COMMENT.sub(b" ", text)
    if text.translate(None, (b"01" if bitmap else b"0123456789") + _BLANKS):
        raise ValueError(f"its samples must be {'digits 0 and 1' if bitmap else 'whole numbers'}")
    packed = text.translate(None, _BLANKS) if bitmap else b""  # digits of a bitmap need no blanks between them
    values = np.frombuffer(packed, np.uint8) - ord("0") if bitmap else np.fromstring(text.strip(), sep=" ")
    _check_length(len(values), math.prod(shape), b"0" * (len(values) > math.prod(shape)), "samples")
    return values.reshape(shape)


def _check_length(found: int, expected: int, behind: bytes, unit: str) -> None:
    """Raise ``ValueError`` unless the picture is complete, and nothing but an end of line is behind it."""
    if found < expected:
        raise ValueError(f"the file is cut short: its header promises {expected} {unit}, there are {found}")
    if behind.startswith(MAGICS):
        raise ValueError("it holds several pictures, and one is read from a file")
    if behind not in {b"", b"\n", b"\r\n"}:
        raise ValueError(f"its header promises {expected} {unit}, there are {found}")
