"""Conversion between OpenCV's pictures, integer arrays (H, W, C) in BGR, and tensors."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import DTypeLike, NDArray
from torch import Tensor

from kornia_tidy.checks import check_finite, check_float_tensor, unmasked

_ROWS = 256  # converted at a time, so that the float64 copy stays small


def from_opencv(picture: NDArray[Any]) -> Tensor:
    """Convert an OpenCV picture to a tensor.

    Args:
        picture: (H, W), (H, W, 1), (H, W, 3) in BGR or (H, W, 4) with alpha, which is dropped; uint8 or uint16.

    Returns:
        (1, H, W), or (3, H, W) in RGB; float32 in [0, 1].

    Raises:
        TypeError: if it is not an array, or has another data type.
        ValueError: if it is of another shape, or a masked array with masked values.

    Example:
        >>> from_opencv(np.array([[[0, 51, 255]]], np.uint8))
        tensor([[[1.0000]],
        <BLANKLINE>
                [[0.2000]],
        <BLANKLINE>
                [[0.0000]]])
    """
    if not isinstance(picture, np.ndarray) or picture.dtype not in (np.uint8, np.uint16):
        kind = picture.dtype if isinstance(picture, np.ndarray) else type(picture).__name__
        raise TypeError(f"a picture of OpenCV's must be an array of uint8 or uint16, got {kind}")
    picture = unmasked("picture", picture)
    planes = picture[..., None] if picture.ndim == 2 else picture
    if planes.ndim != 3 or planes.shape[2] not in {1, 3, 4} or 0 in planes.shape:
        raise ValueError(f"a picture of OpenCV's must have shape (H, W), (H, W, 3) or (H, W, 4), got {picture.shape}")
    planes = planes[..., 2::-1] if planes.shape[2] > 1 else planes
    values = planes.transpose(2, 0, 1).astype(np.float32, order="C")
    values /= np.iinfo(picture.dtype).max
    return torch.from_numpy(values)


def to_opencv(image: Tensor, dtype: DTypeLike = np.uint8) -> NDArray[Any]:
    """Convert a tensor to an OpenCV picture.

    Args:
        image: (3, H, W) in RGB or (1, H, W); values outside [0, 1] are clipped.
        dtype: uint8 or uint16.

    Returns:
        (H, W, 3) in BGR, or (H, W); rounded to the nearest.

    Raises:
        TypeError: if the image is not a floating-point tensor, or the data type is another.
        ValueError: if its shape or a value (NaN, infinity) is not as above.

    Example:
        >>> to_opencv(torch.tensor([[[0.0, 0.5, 2.0]]]), np.uint16)
        array([[    0, 32768, 65535]], dtype=uint16)
    """
    if np.dtype(dtype) not in (np.uint8, np.uint16):
        raise TypeError(f"a picture of OpenCV's must be of uint8 or uint16, got {np.dtype(dtype)}")
    check_float_tensor("image", image, 3, "(C, H, W)")
    channels, height, width = image.shape
    if channels not in {1, 3} or 0 in image.shape:
        raise ValueError(f"image must have shape (3, H, W) or (1, H, W), got {tuple(image.shape)}")
    check_finite("image", image)
    picture = np.empty((height, width, channels), dtype)
    most = 2 ** (8 * picture.itemsize) - 1
    for row in range(0, height, _ROWS):
        band = image[:, row : row + _ROWS].detach().cpu().double()
        values = band.clamp(0, 1).mul_(most).round_().numpy()
        picture[row : row + _ROWS] = values[::-1].transpose(1, 2, 0)
    return picture if channels == 3 else picture[..., 0]
