"""Decoding of image files of any supported format to the numbers stored in them."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from kornia_tidy.data.exr import MAGIC as EXR
from kornia_tidy.data.exr import decode_exr
from kornia_tidy.data.hdf5 import MAGIC as HDF5
from kornia_tidy.data.hdf5 import decode_hdf5
from kornia_tidy.data.netpbm import MAGICS as NETPBM
from kornia_tidy.data.netpbm import decode_netpbm
from kornia_tidy.data.npy import MAGIC as NPY
from kornia_tidy.data.npy import decode_npy
from kornia_tidy.data.npz import MAGIC as NPZ
from kornia_tidy.data.npz import decode_npz
from kornia_tidy.data.orientation import orientation_of
from kornia_tidy.data.pfm import decode_pfm
from kornia_tidy.data.picture_header import JPEG, PNG, check_header, png_chunks
from kornia_tidy.data.quiet import caught
from kornia_tidy.data.tiff import decode_tiff
from kornia_tidy.data.tiff_directories import MAGIC as TIFF
from kornia_tidy.data.transfer import is_linear
from kornia_tidy.files import error_prefix, read_bytes
from kornia_tidy.optics.units import warn_once

# Beginnings of messages about incomplete pictures; surplus bytes at the end, as some cameras write, are harmless.
_DAMAGE = ("libpng error", "Premature end", "Corrupt JPEG data", "Inconsistent progression", "Invalid SOS")
_HARMLESS = "extraneous bytes before marker 0xd9"
_GREY, _PALETTE, _GREY_AND_ALPHA = 0, 3, 4  # colour types of PNG


class Stored(NamedTuple):
    """Numbers of an image file, without any conversion, and their description in the file."""

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
    linear: bool = False
    """Whether the file says that the numbers of a picture are linear light. They are not converted."""


def read_stored(path: str | os.PathLike[str], *, depth: bool = False) -> Stored:
    """Read the numbers in a picture or depth file, without any conversion.

    The format is recognised by content, not by name: PNG, TIFF, JPEG, PBM, PGM, PPM, PAM, PFM, BMP, WebP, NPY, NPZ,
    HDF5 or OpenEXR. The size in the header is checked before decoding, see
    :func:`~kornia_tidy.data.picture_header.check_pixels` for the limit. The orientation is reported, not applied: depth
    maps and calibrations refer to the pixels of the sensor.

    Args:
        path: the file.
        depth: whether depth is wanted. It is taken from the channels of an OpenEXR file, which does not store codes;
            and bitmaps, palettes, and inverted greys are refused, since they are colours.

    Returns:
        The numbers, in the byte order of this machine, and their description in the file. Alpha is dropped; transparent
        depth is marked as missing.

    Raises:
        FileNotFoundError: if the file is missing.
        ValueError: if it is not a regular file, is empty, cut short, damaged or of an unknown format, or has too many
            pixels.
    """
    return decode_stored(read_bytes(path), path, depth=depth)


def decode_stored(data: bytes, path: str | os.PathLike[str], *, depth: bool = False) -> Stored:
    """Decode the bytes of an image file as :func:`read_stored` does; error messages name the path.

    Raises:
        ValueError: if the file is cut short, damaged or of no known format.
    """
    try:
        with error_prefix(f"cannot read {path}"):
            stored = _decode(data, depth)
    except MemoryError:
        raise ValueError(f"cannot read {path}: the memory that it needs is not there") from None
    if depth and data.startswith(JPEG):
        path = Path(path)
        warn_once(
            None,
            ("JPEG", path.parent),
            f"{path} is a JPEG, whose compression changes numbers: depths are off by some units, and holes stored as 0 "
            f"are read as near depths: keep depth in PNG or PFM",
            stacklevel=4,
        )
    values = stored.values[..., None] if stored.values.ndim == 2 else stored.values
    if values.ndim == 3 and values.shape[0] in {1, 3, 4} and values.shape[2] > 4:
        raise ValueError(
            f"cannot read {path}: channels come last, as in (H, W, C), and its shape is {values.shape}: save "
            f"{'array[0]' if values.shape[0] == 1 else 'np.moveaxis(array, 0, -1)'}"
        )
    if values.ndim != 3 or 0 in values.shape:
        raise ValueError(f"cannot read {path}: an image has rows, columns and channels, this is {values.shape}")
    if values.dtype.kind not in "uif":
        raise ValueError(f"cannot read {path}: its values must be integers or real numbers, not {values.dtype}")
    values = values[..., :3] if values.shape[2] == 4 else values
    return stored._replace(values=values.astype(values.dtype.newbyteorder("="), copy=False))


def _decode(data: bytes, depth: bool) -> Stored:
    if data.startswith(NPY):
        return Stored(decode_npy(data))
    if data.startswith(NPZ):
        return Stored(decode_npz(data))
    if data.startswith(HDF5):
        values, unknown, scale = decode_hdf5(data)
        return Stored(values, unknown=unknown if values.ndim == 2 else None, scale=scale)
    if data.startswith((b"PF", b"Pf")):
        return Stored(decode_pfm(data))
    if data.startswith(EXR):
        if not depth:
            raise ValueError(
                "OpenEXR holds linear light without an upper end, and pictures here are encoded in [0, 1]: save it as "
                "PNG with a view transform, or give linear light as a tensor (OpenEXR is read as a depth file)"
            )
        values, unknown = decode_exr(data)
        return Stored(values, unknown=unknown)
    if data.startswith(NETPBM):
        if depth and data.startswith((b"P1", b"P4")):
            raise ValueError("it is a bitmap (PBM) of black and white, which is no depth")
        return Stored(*decode_netpbm(data, depth))
    if data.startswith(TIFF):
        return Stored(*decode_tiff(data, depth))
    decoded = _decode_with_opencv(data)
    if depth and data.startswith(b"BM") and not _is_grey_bmp(data):
        raise ValueError("its pixels are the colours of a palette (BMP), which are no depth")
    stored = _as_in_png(decoded, data, depth) if data.startswith(PNG) else Stored(_colours(decoded))
    return stored._replace(orientation=orientation_of(data), linear=not depth and is_linear(data))


def _is_grey_bmp(data: bytes) -> bool:
    """Return whether a BMP has colours without a palette, or one of 256 greys, each of its own number."""
    old = data[14] == 12  # OS/2
    first, step, bits = 14 + data[14], 3 if old else 4, data[24 if old else 28]
    return bits >= 24 or all(data[(at := first + step * k) : at + 3] == bytes([k] * 3) for k in range(256))


def _as_in_png(decoded: NDArray[Any], data: bytes, depth: bool) -> Stored:
    """Undo OpenCV's scaling of numbers of less than 8 bits and to grey with alpha, and mark transparent depth.

    A file of GDAL marks missing values by the grey level that is transparent.
    """
    bits, kind = data[24], data[25]
    if kind == _PALETTE and depth:
        raise ValueError("its pixels are the colours of a palette (PNG), which are no depth")
    if kind == _GREY_AND_ALPHA:
        unknown = decoded[..., -1] == 0 if depth else None
        return Stored(decoded[..., :1], unknown=unknown)
    decoded = _colours(decoded)
    if kind != _GREY:
        return Stored(decoded)
    white = 2**bits - 1
    values = decoded // (255 // white) if bits < 8 else decoded
    clear = next((int.from_bytes(data[b:e], "big") for k, b, e in png_chunks(data) if k == b"tRNS"), None)
    unknown = values == clear if depth and clear is not None else None
    if depth and (few := next((data[b] for k, b, _ in png_chunks(data) if k == b"sBIT"), bits)) < bits:
        _check_significant(values, bits, few)
    return Stored(values, white if bits < 8 else None, unknown)


def _check_significant(values: NDArray[Any], bits: int, few: int) -> None:
    """Raise ``ValueError`` if depth was scaled up from fewer bits, which the file tells (PNG, section 11.3.2.7)."""
    low = values & (2 ** (bits - few) - 1)
    if values.any() and (not low.any() or (low == values >> few).all()):
        raise ValueError(
            f"its numbers of {few} bits were scaled up to {bits} (sBIT): save them as they were, or remove that chunk"
        )


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
    return decoded


def _colours(decoded: NDArray[Any]) -> NDArray[Any]:
    """Return OpenCV's BGR(A) as RGB, and grey without alpha."""
    if decoded.ndim == 2:
        return decoded
    return decoded[..., 2::-1] if decoded.shape[2] > 2 else decoded[..., :1]
