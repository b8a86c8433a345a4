"""Tensors to OpenCV's pictures, integer arrays (H, W, C) in BGR."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray
from torch import Tensor

from kornia_tidy.checks import check_finite, check_float_tensor

_ROWS = 256  # converted at a time, so that the float64 copy stays small


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
        >>> import torch
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
