"""Decoding of image files of any supported format to the numbers stored in them."""

from __future__ import annotations

import os
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kornia_tidy.data.hdf5 import MAGIC as HDF5
from kornia_tidy.data.hdf5 import decode_hdf5
from kornia_tidy.data.npy import MAGIC as NPY
from kornia_tidy.data.npy import decode_npy
from kornia_tidy.data.pfm import decode_pfm
from kornia_tidy.data.picture_header import check_header
from kornia_tidy.data.quiet import caught
from kornia_tidy.files import read_bytes

# Beginnings of messages about incomplete pictures; surplus bytes at the end, as some cameras write, are harmless.
_DAMAGE = ("libpng error", "Premature end", "Corrupt JPEG data", "Inconsistent progression", "Invalid SOS")
_HARMLESS = "extraneous bytes before marker 0xd9"


def read_stored(path: str | os.PathLike[str]) -> NDArray[Any]:
    """Read the numbers in a PNG, TIFF, JPEG, PGM, PPM, PFM, BMP, WebP, NPY or HDF5 file, without any conversion.

    The format is recognised by content, not by name. The size in the header is checked before decoding, see
    :func:`~kornia_tidy.data.picture_header.check_pixels` for the limit. The orientation in EXIF is ignored: depth maps
    and calibrations refer to the pixels of the sensor.

    Args:
        path: the file.

    Returns:
        (H, W, C) in the data type of the file; channels are grey or R, G, B; alpha is dropped.

    Raises:
        FileNotFoundError: if there is no file.
        ValueError: if it is no regular file, empty, cut short, damaged, of no known format, or has too many pixels.
    """
    return decode_stored(read_bytes(path), path)


def decode_stored(data: bytes, path: str | os.PathLike[str]) -> NDArray[Any]:
    """Decode the bytes of an image file as :func:`read_stored` does; error messages name the path.

    Raises:
        ValueError: if the file is cut short, damaged or of no known format.
    """
    try:
        if data.startswith(NPY):
            stored = decode_npy(data)
        elif data.startswith(HDF5):
            stored = decode_hdf5(data)
        elif data.startswith((b"PF", b"Pf")):
            stored = decode_pfm(data)
        else:
            stored = _decode_with_opencv(data)
    except ValueError as error:
        raise ValueError(f"cannot read {path}: {error}") from error
    except MemoryError:
        raise ValueError(f"cannot read {path}: the memory that it needs is not there") from None
    if stored.ndim == 2:
        stored = stored[..., None]
    if stored.ndim != 3 or 0 in stored.shape:
        raise ValueError(f"cannot read {path}: an image has rows, columns and channels, this is {stored.shape}")
    if stored.dtype.kind not in "uif":
        raise ValueError(f"cannot read {path}: its values must be integers or real numbers, not {stored.dtype}")
    return stored[..., :3] if stored.shape[2] == 4 else stored


def _decode_with_opencv(data: bytes) -> NDArray[Any]:
    check_header(data)
    logging = cv2.utils.logging
    level = logging.getLogLevel()
    logging.setLogLevel(logging.LOG_LEVEL_SILENT)  # bad files raise an error instead
    try:
        with caught() as said:
            decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        decoded = None
    finally:
        if level != logging.LOG_LEVEL_SILENT:  # else another thread silenced it before
            logging.setLogLevel(level)
    if decoded is None:
        raise ValueError("it is damaged, or needs more memory than there is")
    if damage := [line for line in said if line.startswith(_DAMAGE) and _HARMLESS not in line]:
        raise ValueError(f"the file is cut short or damaged ({damage[0]})")
    if decoded.ndim == 2:
        return decoded
    return decoded[..., 2::-1] if decoded.shape[2] > 2 else decoded[..., :1]  # BGR(A) to RGB, or grey with alpha
