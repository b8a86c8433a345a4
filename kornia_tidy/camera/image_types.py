"""Types of images: NumPy arrays, PIL images and whole numbers to tensors in [0, 1], and back."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kornia_tidy.checks import described, unmasked
from kornia_tidy.optics.holes import fill_holes
from kornia_tidy.optics.units import check_depth_scale, metres_per_unit


def image_tensor(image: Any) -> Tensor:
    """Return an image as a floating-point tensor, channels first; whole numbers are divided by the range of their type.

    Args:
        image: a tensor (..., C, H, W); an array (H, W), (H, W, C) or (B, H, W, C); or a PIL image in mode L, I;16 or
            RGB. Floating-point values are not changed, 8-bit ones divided by 255, 16-bit ones by 65535.

    Returns:
        The tensor itself if it is floating point, else float32: (..., C, H, W).

    Raises:
        TypeError: if it is of another kind, or holds other numbers.
        ValueError: if an array has another number of axes or masked values, or a PIL image another mode.

    Example:
        >>> image_tensor(np.full((4, 5, 3), 51, np.uint8))[:, 0, 0]
        tensor([0.2000, 0.2000, 0.2000])
    """
    if type(image) is not Tensor and isinstance(image, Tensor):
        image = image.as_subclass(Tensor)  # MONAI's MetaTensor lacks operators that a capture needs
    if not isinstance(image, Tensor):
        image = torch.from_numpy(_planes(unmasked("image", _array("image", image))))
    if image.is_floating_point():
        return image
    if image.dtype not in (torch.uint8, torch.uint16):
        raise TypeError(f"image must hold floating-point, 8-bit or 16-bit numbers, got {image.dtype}")
    return image.to(torch.float32) / torch.iinfo(image.dtype).max


def like_image(image: Tensor, like: Any) -> Any:
    """Return a tensor in the type of another image: whole numbers rounded and clipped to their range.

    Args:
        image: (..., C, H, W) as :func:`image_tensor` returns.
        like: an image that it takes.

    Example:
        >>> like_image(torch.full((3, 4, 5), 0.2), np.zeros((8, 8, 3), np.uint8))[0, 0]
        array([51, 51, 51], dtype=uint8)
    """
    if isinstance(like, Tensor):
        return image if like.is_floating_point() else _whole(image, like.dtype)
    array = _array("image", like)
    values = image.detach().cpu()
    if array.dtype.kind in "ui":
        values = _whole(values, torch.uint8 if array.dtype == np.uint8 else torch.uint16)
    planes = values.numpy()
    out = planes[0] if array.ndim == 2 else np.ascontiguousarray(np.moveaxis(planes, -3, -1))
    out = out.astype(array.dtype, copy=False)
    return out if isinstance(like, np.ndarray) else sys.modules["PIL.Image"].fromarray(out)


def depth_tensor(depth: Any, scale: float | None = None) -> Tensor:
    """Return a depth map in metres as a floating-point tensor (..., 1, H, W).

    Args:
        depth: a tensor (..., 1, H, W); an array (H, W), (H, W, 1) or (B, H, W, 1); or a PIL image of one channel.
        scale: metres in one stored unit; 0.001 for millimetres. Whole numbers need it; default of others: 1.

    Returns:
        Float32, or float64 where it came so; 0 where a masked array is masked.

    Raises:
        TypeError: if it is of another kind.
        ValueError: if an array has another number of axes or several channels, whole numbers come without a scale, or
            it is not positive or is units per metre.

    Example:
        >>> depth_tensor(np.array([[500, 2000]], np.uint16), 0.001)
        tensor([[[0.5000, 2.0000]]])
    """
    if type(depth) is not Tensor and isinstance(depth, Tensor):
        depth = depth.as_subclass(Tensor)
    if not isinstance(depth, Tensor):
        depth = torch.from_numpy(_planes(np.ma.filled(_array("depth", depth), 0)))
        if depth.shape[-3] != 1:
            raise ValueError(f"depth must have one channel, got {depth.shape[-3]}")
    if depth.is_complex() or depth.dtype == torch.bool:
        raise TypeError(f"depth must hold numbers, got {depth.dtype}")
    scale = metres_per_unit(scale, not depth.is_floating_point(), str(depth.dtype).removeprefix("torch."))
    wide = depth if depth.is_floating_point() else depth.to(torch.float32)
    if scale > 1:
        check_depth_scale(scale, wide.detach().double().cpu().numpy())
    return wide if scale == 1 else wide.to(torch.promote_types(wide.dtype, torch.float32)) * scale


def filled_depth(depth: Any) -> tuple[Any, Any]:
    """Fill the holes of a depth map that :func:`depth_tensor` takes. See :func:`kornia_tidy.data.fill_holes`.

    Returns:
        The depth in its kind, and where it was known: a tensor of bool for a tensor, else an array.

    Example:
        >>> filled_depth(np.array([[500, 0, 2000]], np.uint16))
        (array([[ 500,  500, 2000]], dtype=uint16), array([[ True, False,  True]]))
    """
    if isinstance(depth, Tensor):
        return fill_holes(depth if type(depth) is Tensor else depth.as_subclass(Tensor))
    filled, valid = fill_holes(_array("depth", depth))
    return filled if isinstance(depth, np.ndarray) else sys.modules["PIL.Image"].fromarray(filled), valid


def cropped_image(image: Any, margin: int) -> Any:
    """Return a tensor (..., H, W), an array (H, W), (H, W, C) or (B, H, W, C), or a PIL image, without its edges.

    Args:
        image: or a depth map.
        margin: pixels less on each side.

    Example:
        >>> cropped_image(np.zeros((8, 9, 3)), 2).shape
        (4, 5, 3)
    """
    if not margin:
        return image
    if isinstance(image, Tensor):
        return image[..., margin:-margin, margin:-margin]
    if isinstance(image, np.ndarray):
        inner = slice(margin, -margin)
        return image[:, inner, inner] if image.ndim == 4 else image[inner, inner]
    return image.crop((margin, margin, image.width - margin, image.height - margin))


def _array(name: str, value: Any) -> np.ndarray:
    """Return an array or a PIL image as an array."""
    if isinstance(value, np.ndarray):
        return value
    pil = sys.modules.get("PIL.Image")
    if pil is not None and isinstance(value, pil.Image):
        if value.mode not in ("L", "RGB", "I;16", "I", "F"):
            raise ValueError(f"{name} must be a PIL image in mode L, RGB or I;16, got {value.mode}: convert('RGB')")
        return np.array(value)
    raise TypeError(f"{name} must be a tensor, a NumPy array or a PIL image, got {described(value)}")


def _planes(array: np.ndarray) -> np.ndarray:
    """Return an array with its channels before rows and columns."""
    if array.ndim == 2:
        array = array[None]
    elif array.ndim in (3, 4):
        array = np.moveaxis(array, -1, -3)
    else:
        raise ValueError(f"an array must be (H, W), (H, W, C) or (B, H, W, C), got {array.shape}")
    return np.array(array, dtype=array.dtype.newbyteorder("="), order="C")  # own memory: torch refuses read-only ones


def _whole(image: Tensor, dtype: torch.dtype) -> Tensor:
    top = torch.iinfo(dtype).max
    return (image.to(torch.promote_types(image.dtype, torch.float32)).clamp(0, 1) * top).round().to(dtype)
