"""Netpbm files: PGM and PPM, plain and raw.

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

MAGICS = (b"P2", b"P3", b"P5", b"P6")
LARGEST = 65535  # of samples

_BLANKS = b" \t\n\v\f\r"
_NUMBER = re.compile(rb"(?:[ \t\n\v\f\r]|#[^\r\n]*+[\r\n])++(\d{1,10})(?=[ \t\n\v\f\r#])")
_COMMENT = re.compile(rb"#[^\r\n]*")

Shape = tuple[int, int, int]
"""Rows, columns and channels."""


def decode_netpbm(data: bytes) -> tuple[NDArray[Any], int]:
    r"""Decode a PGM or PPM file of one picture.

    Args:
        data: bytes of the file.

    Returns:
        The stored samples, (H, W, C) uint8 or uint16; and the maximum, which means white.

    Raises:
        ValueError: if the header is damaged, the picture too large, the file cut short or longer than its picture, or
            a sample above the maximum.

    Source: Netpbm's pgm(5) and ppm(5).

    Example:
        >>> values, white = decode_netpbm(b"P2 3 1 # a comment\n15  0 5 15")
        >>> values[..., 0], white
        (array([[ 0,  5, 15]], dtype=uint8), 15)
    """
    shape, white, end = _header(data)
    check_pixels("the picture", *shape[:2])
    if not 1 <= white <= LARGEST:
        raise ValueError(f"its maximum must be 1 to {LARGEST}, it is {white}")
    plain = data[:2] in {b"P2", b"P3"}
    values = _plain_samples(data[end:], shape) if plain else _raw_samples(data, end, shape, white)
    if (largest := values.max(initial=0)) > white:
        raise ValueError(f"it holds {largest:.10g}, more than the maximum {white} in its header")
    return values.astype(np.uint8 if white < 256 else np.uint16), white


def _header(data: bytes) -> tuple[Shape, int, int]:
    """Return the shape, the maximum, and the offset behind the last number."""
    found, end = [], 2
    for _ in range(3):
        match = _NUMBER.match(data, end)
        if match is None:
            raise ValueError("its Netpbm header is cut short or damaged: columns, rows and maximum are whole numbers")
        found.append(int(match[1]))
        end = match.end()
    columns, rows, white = found
    return (rows, columns, 3 if data[:2] in {b"P3", b"P6"} else 1), white, end


def _raw_samples(data: bytes, end: int, shape: Shape, white: int) -> NDArray[Any]:
    kind = np.dtype(np.uint8 if white < 256 else ">u2")
    length = math.prod(shape) * kind.itemsize
    start = end + 1  # a single blank separates header and samples
    doubled = data[end : end + 2] == b"\r\n"
    if (comment := _COMMENT.match(data, end)) is not None:  # its end takes the place of the blank, or precedes it
        start = comment.end() + 1
        doubled = data[start : start + 1].isspace()
    start += doubled and len(data) - start == length + 1
    _check_length(len(data) - start, length, data[start + length :], "bytes")
    return np.frombuffer(data, kind, math.prod(shape), start).reshape(shape)


def _plain_samples(text: bytes, shape: Shape) -> NDArray[Any]:
    if b"#" in text:
        text = _COMMENT.sub(b" ", text)
    if text.translate(None, b"0123456789" + _BLANKS):
        raise ValueError("its samples must be whole numbers")
    values = np.fromstring(text.strip(), sep=" ")
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
