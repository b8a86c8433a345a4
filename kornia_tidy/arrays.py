"""The conversion between tensors and arrays, PIL images or whole numbers: images in [0, 1], depth in metres."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kornia_tidy.checks import check_finite, check_float_tensor, check_positive, described, unmasked

FAR_WHOLE = 500.0  # m; nearer depths may well be stored as whole numbers of several metres each
FARTHEST = 1e5  # m; a farther pixel is sky, whose value no depth map in millimetres reaches
_ROWS = 256  # rounded at a time, so that the copy in float64 stays small


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
        image = torch.from_numpy(_planes(unmasked("image", as_array("image", image))))
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
    array = as_array("image", like)
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
        depth = torch.from_numpy(_planes(np.ma.filled(as_array("depth", depth), 0)))
        if depth.shape[-3] != 1:
            raise ValueError(f"depth must have one channel, got {depth.shape[-3]}")
    if depth.is_complex() or depth.dtype == torch.bool:
        raise TypeError(f"depth must hold numbers, got {depth.dtype}")
    scale = metres_per_unit(scale, not depth.is_floating_point(), str(depth.dtype).removeprefix("torch."))
    wide = depth if depth.is_floating_point() else depth.to(torch.float32)
    if scale > 1:
        check_depth_scale(scale, wide.detach().double().cpu().numpy())
    return wide if scale == 1 else wide.to(torch.promote_types(wide.dtype, torch.float32)) * scale


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


def to_opencv(image: Tensor, dtype: type | np.dtype = np.uint8) -> np.ndarray:
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
    if image.shape[0] not in {1, 3} or 0 in image.shape:
        raise ValueError(f"image must have shape (3, H, W) or (1, H, W), got {tuple(image.shape)}")
    check_finite("image", image)
    return like_image(image.flip(0), np.empty((0,) * (2 if image.shape[0] == 1 else 3), dtype))


def metres_per_unit(scale: float | None, whole: bool, kind: Any) -> float:
    """Return the metres in one stored unit of a depth map: the scale, or 1 for floating-point numbers without one.

    Args:
        scale: metres per unit, or None.
        whole: whether whole numbers are stored.
        kind: their data type, for the message.

    Raises:
        ValueError: if whole numbers come without a scale, or it is not positive.

    Example:
        >>> metres_per_unit(None, False, "float32"), metres_per_unit(0.001, True, "uint16")
        (1.0, 0.001)
    """
    if scale is None and whole:
        raise ValueError(f"a depth of {kind} needs depth_scale, metres per unit, such as 0.001 for millimetres")
    check_positive("depth_scale", 1.0 if scale is None else scale, "metres per unit")
    return 1.0 if scale is None else float(scale)


def check_depth_scale(scale: float, stored: np.ndarray) -> None:
    """Raise if a scale is probably units for each metre, as in Open3D, TUM RGB-D and ROS, instead of metres per unit.

    Two conditions must hold. A unit is more than a metre. The near pixels, at the lowest hundredth, are at 500 m
    or farther, or at 100 km where values have fractions, as depth in kilometres does.

    Args:
        scale: metres for each stored unit.
        stored: known values of a depth map, any shape; only positive and finite ones count.

    Raises:
        ValueError: if both hold.

    Example:
        >>> check_depth_scale(1000, np.array([700, 1500]))
        Traceback (most recent call last):
        ValueError: depth_scale is metres for each stored unit, and 1000 puts near pixels at 7e+05 m: for 1000 \
units in a metre give 0.001, not 1000; for metres 1 (--depth-scale)
        >>> check_depth_scale(1000, np.array([0.5, 2.25]))  # kilometres
    """
    if scale <= 1:
        return
    known = stored[(stored > 0) & np.isfinite(stored)]
    if not known.size:
        return
    near = scale * float(np.quantile(known, 0.01, method="nearest"))
    if near >= (FAR_WHOLE if bool((known == np.rint(known)).all()) else FARTHEST):
        raise ValueError(
            f"depth_scale is metres for each stored unit, and {scale:g} puts near pixels at {near:.3g} m: for "
            f"{scale:g} units in a metre give {1 / scale:.6g}, not {scale:g}; for metres 1 (--depth-scale)"
        )


def as_array(name: str, value: Any) -> np.ndarray:
    """Return an array or a PIL image as an array."""
    if isinstance(value, np.ndarray):
        if value.dtype.kind not in "biufc":
            raise TypeError(f"{name} must hold numbers, got {value.dtype}")
        return value
    pil = sys.modules.get("PIL.Image")
    if pil is not None and isinstance(value, pil.Image):
        if value.mode not in ("L", "RGB", "I;16", "I;16B", "I", "F"):
            modes, remedy = ("L, I;16, I or F", "") if name == "depth" else ("L, RGB or I;16", ": convert('RGB')")
            raise ValueError(f"{name} must be a PIL image in mode {modes}, got {value.mode}{remedy}")
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
    extended = array.dtype.kind == "f" and array.dtype.itemsize > 8  # which torch has no type for
    dtype = np.dtype(np.float64) if extended else array.dtype.newbyteorder("=")
    return np.array(array, dtype=dtype, order="C")  # own memory: torch refuses read-only ones


def _whole(image: Tensor, dtype: torch.dtype) -> Tensor:
    """Return an image in whole numbers, rounded in float64 where the device has it."""
    wide, top = torch.float64 if image.device.type == "cpu" else torch.float32, torch.iinfo(dtype).max
    whole = torch.empty_like(image, dtype=dtype)
    for band, rows in zip(image.split(_ROWS, -2), whole.split(_ROWS, -2), strict=True):
        rows.copy_((band.to(wide).clamp(0, 1) * top).round())
    return whole
