"""The numbers an image file stores, whatever its format."""

from __future__ import annotations

import os
from io import BytesIO
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from kornia_tidy.data.pfm import decode_pfm
from kornia_tidy.files import read_bytes

PNG, JPEG, NPY = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff", b"\x93NUMPY"


def read_stored(path: str | os.PathLike[str]) -> NDArray[Any]:
    """Read the numbers a file stores, as they are: PNG, TIFF, JPEG, PGM/PPM, PFM, NPY and what else OpenCV decodes.

    The format is told from the content, not from the name. An orientation written in EXIF is ignored: depth maps and
    calibrations belong to the sensor's own grid of pixels.

    Args:
        path: the file.

    Returns:
        (H, W, C) in the file's own data type; channels are grey or R, G, B; a fourth one, alpha, is dropped.

    Raises:
        FileNotFoundError: if there is no file.
        ValueError: if it is a folder, empty, cut short, damaged or of no known format.
    """
    return decode_stored(read_bytes(path), path)


def decode_stored(data: bytes, path: str | os.PathLike[str]) -> NDArray[Any]:
    """Return the numbers in the bytes of a file, as :func:`read_stored` does; messages call it by its path.

    Raises:
        ValueError: if they are cut short, damaged or of no known format.
    """
    try:
        if data.startswith(NPY):
            stored = np.lib.format.read_array(BytesIO(data), allow_pickle=False)
        elif data.startswith((b"PF", b"Pf")):
            stored = decode_pfm(data)
        else:
            stored = _decode_with_opencv(data)
    except (ValueError, EOFError, MemoryError, TypeError, OverflowError) as error:
        raise ValueError(f"cannot read {path}: {error}") from error
    if stored.ndim == 2:
        stored = stored[..., None]
    if stored.ndim != 3 or 0 in stored.shape:
        raise ValueError(f"cannot read {path}: an image has rows, columns and channels, this is {stored.shape}")
    if stored.dtype.kind not in "uif":
        raise ValueError(f"cannot read {path}: its values must be integers or real numbers, not {stored.dtype}")
    return stored[..., :3] if stored.shape[2] == 4 else stored


def _decode_with_opencv(data: bytes) -> NDArray[Any]:
    # Some versions of OpenCV fill up what is missing at the end with grey, and say nothing. In a JPEG an end marker
    # must follow the last start of a scan; the data of a scan cannot look like either.
    cut_jpeg = data.startswith(JPEG) and data.rfind(b"\xff\xd9") < data.rfind(b"\xff\xda")
    if cut_jpeg or (data.startswith(PNG) and b"IEND" not in data):
        raise ValueError("the file is cut short")
    logging = cv2.utils.logging
    level = logging.getLogLevel()
    logging.setLogLevel(logging.LOG_LEVEL_SILENT)  # a bad file raises; OpenCV need not print it too
    try:
        decoded = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        decoded = None
    finally:
        if level != logging.LOG_LEVEL_SILENT:  # another thread may have found it silenced by this one
            logging.setLogLevel(level)
    if decoded is None:
        raise ValueError("it is not an image in a known format, or it is damaged")
    if decoded.ndim == 2:
        return decoded
    return decoded[..., 2::-1] if decoded.shape[2] > 2 else decoded[..., :1]  # BGR(A) to RGB, or grey with alpha
