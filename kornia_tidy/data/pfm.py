"""PFM, the portable float map, in which stereo data sets store disparity.

OpenCV's reader is not used: it multiplies Middlebury's disparities by 255, refuses FlyingThings3D's headers, accepts
bytes too many, and takes 145 ms for 6 megapixels where this one takes 11 ms.
"""

from __future__ import annotations

import re

import numpy as np
from numpy.typing import NDArray

HEADER = re.compile(rb"(PF|Pf)\s+(\d{1,9})\s+(\d{1,9})\s+([-+.\deE]{1,32})[ \t]*\r?\n")


def decode_pfm(data: bytes) -> NDArray[np.float32]:
    r"""Decode a PFM file.

    Blanks at the ends of header lines are accepted, as FlyingThings3D has them. The number of bytes must agree with the
    header.

    Args:
        data: bytes of the file.

    Returns:
        (H, W) for ``Pf``, (H, W, 3) for ``PF``, native float32.

    Raises:
        ValueError: if the header or the length is wrong.

    Convention:
        - The first row returned is the top one; the first in the file is the bottom one.
        - A negative scale in the header means little-endian. Values are not multiplied by the scale: Middlebury's
          files have 0.003922, and their stored values are the disparities.

    Source: Debevec, PFM Portable FloatMap Image Format.

    Example:
        >>> decode_pfm(b"Pf\n1 2\n-1.0\n" + np.array([1, 2], "<f4").tobytes()).tolist()
        [[2.0], [1.0]]
    """
    header = HEADER.match(data)
    if header is None:
        raise ValueError("its PFM header is not 'Pf' or 'PF', width, height and scale")
    magic, width, height, scale = header.groups()
    try:
        little_endian = float(scale) < 0
    except ValueError as error:
        raise ValueError(f"its PFM header gives the scale as {scale.decode()!r}") from error
    if float(scale) == 0:
        raise ValueError("its PFM header gives the scale as 0, which has no sign and so no byte order")
    shape = (int(height), int(width), 3) if magic == b"PF" else (int(height), int(width))
    expected, found = 4 * int(np.prod(shape, dtype=object)), len(data) - header.end()
    if found != expected:
        raise ValueError(f"its PFM header promises {expected} bytes of values, there are {found}")
    values = np.frombuffer(data, "<f4" if little_endian else ">f4", offset=header.end()).reshape(shape)
    return values[::-1].astype(np.float32)


def encode_pfm(values: NDArray[np.float32]) -> bytes:
    """Encode values (H, W) or (H, W, 3), top row first, as a little-endian PFM file."""
    magic = "PF" if values.ndim == 3 else "Pf"
    height, width = values.shape[:2]
    return f"{magic}\n{width} {height}\n-1.0\n".encode() + values[::-1].astype("<f4").tobytes()
