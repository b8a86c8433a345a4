"""NPY files, read without trusting their header: ``numpy.load`` evaluates it and allocates memory for its size."""

from __future__ import annotations

import io
import math
import re
import struct
from typing import Any

import numpy as np
from numpy.typing import NDArray

MAGIC = b"\x93NUMPY"
_LENGTHS = {1: "<H", 2: "<I", 3: "<I"}  # of the header, by version
_KIND = re.compile(r"""['"]descr['"]\s*:\s*(?:(['"])([^'"]*)\1|\[)""")
_ORDER = re.compile(r"""['"]fortran_order['"]\s*:\s*(True|False)\b""")
_SHAPE = re.compile(r"""['"]shape['"]\s*:\s*\(((?:\s*\d{1,15}L?\s*,)*(?:\s*\d{1,15}L?)?)\s*\)""")
_NUMBERS = re.compile(r"[<>=|]?(?:b1|[iu][1248]|f[248]|c(?:8|16))")
_LONG_NUMBERS = re.compile(r"[<>=]?(?:f1[26]|c(?:24|32))")  # extended precision
_MOST_AXES = 8


def decode_npy(data: bytes) -> NDArray[Any]:
    """Decode an NPY file.

    The header is not evaluated, and nothing is unpickled. The number of bytes is compared with the header before memory
    is allocated.

    Args:
        data: bytes of the file.

    Returns:
        The array of booleans, integers, real or complex numbers, in the byte order of this machine.

    Raises:
        ValueError: if the header or the length is wrong, or the values are not numbers.

    Source: NumPy enhancement proposal 1, "A simple file format for NumPy arrays".

    Example:
        >>> decode_npy(encode_npy(np.array([[1, 2]], ">u2")))
        array([[1, 2]], dtype=uint16)
    """
    dtype, fortran_order, shape, start = npy_header(data)
    expected, found = dtype.itemsize * math.prod(shape), len(data) - start
    if found != expected:
        raise ValueError(f"its NPY header promises {expected} bytes of values, there are {found}")
    values = np.frombuffer(data, dtype, offset=start).reshape(shape, order="F" if fortran_order else "C")
    return values.astype(dtype.newbyteorder("="))


def encode_npy(values: NDArray[Any]) -> bytes:
    """Encode an array as an NPY file."""
    file = io.BytesIO()
    np.lib.format.write_array(file, values, allow_pickle=False)
    return file.getvalue()


def npy_header(data: bytes) -> tuple[np.dtype[Any], bool, tuple[int, ...], int]:
    """Return the data type, whether columns vary fastest, the shape, and the offset of the values of an NPY file.

    Args:
        data: the beginning of the file, at least as far as its header reaches.

    Raises:
        ValueError: if the header is wrong, or the values are not numbers.
    """
    version = data[6] if len(data) > 6 else 0
    if not data.startswith(MAGIC) or version not in _LENGTHS:
        raise ValueError("it is not an NPY file of version 1, 2 or 3")
    begin = 8 + struct.calcsize(_LENGTHS[version])
    start = begin + struct.unpack_from(_LENGTHS[version], data, 8)[0] if len(data) >= begin else begin
    if len(data) < start:
        raise ValueError("its NPY header is cut short")
    return (*_header(data[begin:start].decode("latin-1")), start)


def _header(text: str) -> tuple[np.dtype[Any], bool, tuple[int, ...]]:
    kind, order, shape = (part.search(text) for part in (_KIND, _ORDER, _SHAPE))
    if kind is None or order is None or shape is None:
        raise ValueError("its NPY header does not tell data type, order and shape")
    name = kind[2] if kind[1] else "a record"
    if not _NUMBERS.fullmatch(name):
        reason = "has more than 64 bits a number" if _LONG_NUMBERS.fullmatch(name) else "is none of numbers"
        raise ValueError(f"its NPY header names the data type {name[:20]!r}, which {reason}")
    axes = tuple(int(side.strip(" L")) for side in shape[1].split(",") if side.strip())
    if len(axes) > _MOST_AXES:
        raise ValueError(f"its NPY header tells of {len(axes)} axes, more than {_MOST_AXES}")
    return np.dtype(name), order[1] == "True", axes
