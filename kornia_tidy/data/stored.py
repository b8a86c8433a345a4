"""Decoding of image files of any supported format to the numbers stored in them."""

from __future__ import annotations

import os
from typing import Any, NamedTuple

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
from kornia_tidy.data.tiff import decode_tiff
from kornia_tidy.data.tiff_directories import MAGIC as TIFF
from kornia_tidy.files import read_bytes

# Beginnings of messages about incomplete pictures; surplus bytes at the end, as some cameras write, are harmless.
_DAMAGE = ("libpng error", "Premature end", "Corrupt JPEG data", "Inconsistent progression", "Invalid SOS")
_HARMLESS = "extraneous bytes before marker 0xd9"


class Stored(NamedTuple):
    """Numbers of an image file, without any conversion, and what the file says of them."""

    values: NDArray[Any]
    """(H, W, C) in the data type of the file, rows and columns as they are stored; channels are grey or R, G, B."""
    white: float | None = None
    """Number that means 1 in a picture of integers; None: the largest of the data type."""
    unknown: NDArray[np.bool_] | None = None
    """(H, W), True where the file marks a pixel as missing; None: it marks none."""
    orientation: int = 1
    """How the picture is to be turned for display, 1 to 8 as in EXIF; 1: not at all. The values are not turned."""
    scale: float = 1.0
    """Factor by which the file says that its numbers are to be multiplied. They are not."""


def read_stored(path: str | os.PathLike[str], *, depth: bool = False) -> Stored:
    """Read the numbers in a PNG, TIFF, JPEG, PGM, PPM, PFM, BMP, WebP, NPY or HDF5 file, without any conversion.

    The format is recognised by content, not by name. The size in the header is checked before decoding, see
    :func:`~kornia_tidy.data.picture_header.check_pixels` for the limit. The orientation in EXIF is ignored: depth maps
    and calibrations refer to the pixels of the sensor.

    Args:
        path: the file.
        depth: whether depth is wanted, not a picture: palettes, and numbers of which 0 is white, are then refused.

    Returns:
        The numbers, and what the file says of them; alpha is dropped.

    Raises:
        FileNotFoundError: if there is no file.
        ValueError: if it is no regular file, empty, cut short, damaged, of no known format, or has too many pixels.
    """
    return decode_stored(read_bytes(path), path, depth=depth)


def decode_stored(data: bytes, path: str | os.PathLike[str], *, depth: bool = False) -> Stored:
    """Decode the bytes of an image file as :func:`read_stored` does; error messages name the path.

    Raises:
        ValueError: if the file is cut short, damaged or of no known format.
    """
    try:
        stored = _decode(data, depth)
    except ValueError as error:
        raise ValueError(f"cannot read {path}: {error}") from error
    except MemoryError:
        raise ValueError(f"cannot read {path}: the memory that it needs is not there") from None
    values = stored.values[..., None] if stored.values.ndim == 2 else stored.values
    if values.ndim != 3 or 0 in values.shape:
        raise ValueError(f"cannot read {path}: an image has rows, columns and channels, this is {values.shape}")
    if values.dtype.kind not in "uif":
        raise ValueError(f"cannot read {path}: its values must be integers or real numbers, not {values.dtype}")
    return stored._replace(values=values[..., :3] if values.shape[2] == 4 else values)


def _decode(data: bytes, depth: bool) -> Stored:
    if data.startswith(NPY):
        return Stored(decode_npy(data))
    if data.startswith(HDF5):
        return Stored(decode_hdf5(data))
    if data.startswith((b"PF", b"Pf")):
        return Stored(decode_pfm(data))
    if data.startswith(TIFF):
        return Stored(*decode_tiff(data, depth))
    return Stored(_decode_with_opencv(data))


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
