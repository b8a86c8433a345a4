"""Image files: reading and writing pictures as tensors in [0, 1]."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from kornia_tidy.arrays import to_opencv
from kornia_tidy.checks import check_choice
from kornia_tidy.data.metadata import with_exif
from kornia_tidy.data.orientation import tell_orientation
from kornia_tidy.data.stored import Stored, read_stored
from kornia_tidy.data.transfer import tell_linear
from kornia_tidy.files import write_bytes

SUFFIXES = (".png", ".tif", ".tiff", ".jpg", ".jpeg")


def read_image(path: str | os.PathLike[str]) -> Tensor:
    """Read a picture as a tensor in [0, 1].

    Args:
        path: an 8- or 16-bit PNG, TIFF, JPEG, BMP, WebP, PBM, PGM, PPM or PAM, or a TIFF, PFM, NPY or NPZ of floats
            that lie in [0, 1]. An array has the layout (H, W) or (H, W, C) with channels R, G, B, and is never
            unpickled; an NPZ archive holds one.

    Returns:
        :math:`(3, H, W)`, or :math:`(1, H, W)` for a grey file, float32 in [0, 1], encoded as in the file (usually
        sRGB).

    Raises:
        FileNotFoundError: if the file is missing.
        ValueError: if it is not an image, is cut short or damaged, has other channels, types or floats outside [0, 1],
            is encoded for HDR (PQ or HLG), or needs more memory than the machine has.

    Warns:
        UserWarning: if viewers turn the picture, by its EXIF or XMP orientation: once for each folder, size and
            orientation; and if the file says that it holds linear light, once for each folder and format.

    Convention:
        - Alpha is dropped. Integers are divided by the maximum that a PGM, PPM or PAM file gives, else by the largest
          of their bits.
        - A TIFF holds one picture, of 1 to 16 bits, and is read as :func:`~kornia_tidy.data.tiff.decode_tiff` says.
        - Numbers are not converted. A warning tells of a file that says by its ICC profile, gAMA or cICP that they are
          linear light: give the camera ``color_space="linear"``.
        - The orientation is not applied: a depth map of the same camera has none, and calibrations refer to the pixels
          of the sensor. Depth that was estimated from the upright picture must be turned, as the warning says.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_image(f"{folder}/grey.png", torch.tensor([[[0.0, 0.2, 1.0]]]))
        ...     read_image(f"{folder}/grey.png")
        tensor([[[0.0000, 0.2000, 1.0000]]])
    """
    file = read_stored(path)
    tell_orientation(path, file.orientation, file.values.shape[:2], "picture")
    tell_linear(path, file.linear)
    return as_image(file, path)


def read_linear(path: str | os.PathLike[str]) -> Tensor:
    """Read a picture of linear light: as :func:`read_image`, without the warning of a file that says so."""
    file = read_stored(path)
    tell_orientation(path, file.orientation, file.values.shape[:2], "picture")
    return as_image(file, path)


def as_image(file: Stored, path: str | os.PathLike[str]) -> Tensor:
    """Return the numbers of a picture file (H, W, C) as floats in [0, 1], (C, H, W); error messages name the path.

    Raises:
        ValueError: if it has other channels, types or floats outside [0, 1], or needs more memory than there is.
    """
    try:
        return _scaled(file, path)
    except MemoryError as error:  # of the floats, which take up to four times the memory of the stored pixels
        raise ValueError(f"cannot read {path}: it needs more memory than there is") from error


def _scaled(file: Stored, path: str | os.PathLike[str]) -> Tensor:
    stored = file.values
    channels = stored.shape[2]
    if channels not in {1, 3}:
        raise ValueError(f"cannot read {path}: an image has 1, 3 or 4 channels, this has {channels}")
    if stored.dtype in {np.dtype(np.uint8), np.dtype(np.uint16)}:
        values = stored.astype(np.float32) / np.float32(file.white or np.iinfo(stored.dtype).max)
    elif stored.dtype.kind == "f":
        if not (stored.min() >= 0 and stored.max() <= 1):  # False for NaN too
            raise ValueError(
                f"cannot read {path}: floats must lie in [0, 1], found {stored.min():.9g} to {stored.max():.9g}"
            )
        values = stored.astype(np.float32)
    else:
        raise ValueError(f"cannot read {path}: values must be 8- or 16-bit unsigned or floats, not {stored.dtype}")
    return torch.from_numpy(np.ascontiguousarray(values.transpose(2, 0, 1)))


def write_image(
    path: str | os.PathLike[str], image: Tensor, bits: int = 8, info: Mapping[str, Any] | None = None
) -> None:
    """Write a picture as PNG, TIFF or JPEG, by the suffix of the path. The write is atomic.

    Args:
        path: of the file; an existing one is replaced.
        image: :math:`(3, H, W)` or :math:`(1, H, W)`, encoded, in [0, 1]; values outside are clipped.
        bits: 8, or 16 for PNG and TIFF.
        info: camera and exposure, written as EXIF; see :func:`~kornia_tidy.data.metadata.with_exif`.

    Raises:
        TypeError: if the image is not a floating-point tensor.
        ValueError: if its shape, a value (NaN, infinity), the bits or the suffix is not as above.
        FileNotFoundError: if the folder does not exist.
    """
    write_bytes(path, with_exif(encode_image(image, Path(path).suffix.lower(), bits), info or {}))


def encode_image(image: Tensor, suffix: str = ".png", bits: int = 8) -> bytes:
    """Return the bytes of the file that :func:`write_image` writes under a name with this suffix.

    Example:
        >>> encode_image(torch.rand(3, 4, 6), bits=16)[1:4]
        b'PNG'
    """
    check_choice("the suffix of an image file", suffix, SUFFIXES)
    check_choice(f"bits of a {suffix} file", bits, (8,) if suffix in {".jpg", ".jpeg"} else (8, 16))
    done, encoded = cv2.imencode(suffix, to_opencv(image, np.uint8 if bits == 8 else np.uint16))
    if not done:
        raise ValueError(f"OpenCV cannot encode an image of shape {tuple(image.shape)} as {suffix}")
    return encoded.tobytes()
