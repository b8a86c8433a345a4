"""NPZ archives that hold one array, as ``numpy.savez`` writes them."""

from __future__ import annotations

import io
import math
import struct
import zipfile
import zlib
from typing import Any

from numpy.typing import NDArray

from kornia_tidy.data.npy import decode_npy, npy_header
from kornia_tidy.data.picture_header import check_pixels
from kornia_tidy.files import error_prefix

MAGIC = b"PK\3\4"

_LONGEST_HEADER = 1 << 16  # bytes of a member that are unfolded before its size is known
_DAMAGE = (zipfile.BadZipFile, zlib.error, struct.error, EOFError, OSError, ValueError, OverflowError, IndexError,
           KeyError, NotImplementedError)  # fmt: skip


def decode_npz(data: bytes) -> NDArray[Any]:
    """Decode the only array of an NPZ archive.

    The size in the array's own header is checked before it is unfolded, and nothing is unpickled.

    Args:
        data: bytes of the file.

    Raises:
        ValueError: if the archive is damaged, holds no array or several, is encrypted or compressed by another method
            than Deflate, or its array is too large or none of numbers.

    Source: PKWARE's APPNOTE 6.3, for the archive; see :func:`~kornia_tidy.data.npy.decode_npy` for its member.

    Example:
        >>> import numpy as np
        >>> file = io.BytesIO()
        >>> np.savez_compressed(file, depth=np.array([[1, 2]], np.uint16))
        >>> decode_npz(file.getvalue())
        array([[1, 2]], dtype=uint16)
    """
    with error_prefix("its ZIP archive is cut short or damaged", *_DAMAGE):
        archive = zipfile.ZipFile(io.BytesIO(data))
    members = [member for member in archive.infolist() if not member.is_dir()]
    names = ", ".join(ascii(member.filename)[1:-1] for member in members[:9])[:120]
    if not any(member.filename.endswith(".npy") for member in members):
        raise ValueError(f"it is a ZIP archive without arrays, it holds {names or 'nothing'}")
    if len(members) > 1:
        raise ValueError(f"its NPZ holds {len(members)} arrays, {names}, and one is read: save that by numpy.save")
    (member,) = members
    if member.flag_bits & 1:
        raise ValueError("its NPZ is encrypted")
    if member.compress_type not in {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}:
        raise ValueError(
            f"its NPZ is compressed by method {member.compress_type}, and read are Deflate (8) and none (0)"
        )
    return decode_npy(_unfolded(archive, member))


def _unfolded(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> bytes:
    """Return the bytes of an NPY file in an archive, after a look at its header."""
    with error_prefix("its NPZ is damaged", *_DAMAGE), archive.open(member) as file:
        beginning = file.read(_LONGEST_HEADER)
    dtype, _, shape, start = npy_header(beginning)
    channels = shape[-1] if len(shape) > 2 and shape[-1] in {1, 2, 3, 4} else 1
    check_pixels("the array", shape[0] if shape else 1, math.prod(shape[1:]) // channels)
    expected = start + dtype.itemsize * math.prod(shape)
    if member.file_size != expected:
        raise ValueError(f"its NPY header promises {expected} bytes, the archive {member.file_size}")
    with error_prefix("its NPZ is damaged", *_DAMAGE):
        return archive.read(member)  # its check sum is compared at the end
