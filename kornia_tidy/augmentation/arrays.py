"""Captures and reconstructions of NumPy arrays in one call, in OpenCV's layout and colour order."""

from __future__ import annotations

import os
import warnings
from functools import cache, lru_cache
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from kornia.color import rgb_to_linear_rgb
from numpy.typing import NDArray
from torch import Tensor

from kornia_tidy.arrays import depth_tensor, image_tensor, like_image
from kornia_tidy.augmentation.lens_argument import lens_optics, lens_parts
from kornia_tidy.camera.holes import fills_holes
from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.checks import check_choice, check_part, check_positive, checked_seed, described, unmasked
from kornia_tidy.choices import REPLACED
from kornia_tidy.masks.pixelwise import PixelwiseMask
from kornia_tidy.optics.holes import HOLES, fill_holes
from kornia_tidy.optics.lens.lens import Lens
from kornia_tidy.psf.psf_bank import PSFBank
from kornia_tidy.reconstruction.camera_system import any_camera_system, saved_system, sensor_of
from kornia_tidy.reconstruction.hub import from_pretrained
from kornia_tidy.reconstruction.light_head import LightHead, reconstruct_light
from kornia_tidy.reconstruction.pretrained import PRETRAINED, load_pretrained
from kornia_tidy.reconstruction.trained import TrainedSystem

Color = Literal["bgr", "rgb"]
IMAGES = (np.dtype(np.uint8), np.dtype(np.uint16), np.dtype(np.float32))
SHAPES = "(H, W), (H, W, 3) or, as a batch, (B, H, W, 1) or (B, H, W, 3)"


class Reconstructed(NamedTuple):
    """Arrays that a system reconstructs from captures; None for a map that it was not trained for."""

    image: NDArray[Any] | None
    """All-in-focus image, in the captures' data type and colour order, encoded as sRGB."""
    depth: NDArray[np.float32] | None
    """Depth in metres, (H, W) or (B, H, W); may be infinite."""


def simulate(
    image: NDArray[Any],
    depth: NDArray[Any],
    depth_scale: float | None = None,
    *,
    optics: TiDyOptics | None = None,
    color: Color = "bgr",
    seed: int | None = None,
    holes: str = "error",
    lens: Lens | str | None = None,
    field_center: Any = None,
) -> NDArray[Any]:
    """Simulate the coded capture of arrays, such as OpenCV reads.

    Args:
        image: (H, W), (H, W, 3) or, as a batch, (B, H, W, 1) or (B, H, W, 3); uint8 or uint16 in the range of the type,
            or float32 in [0, 1]. Encoded as sRGB, or as the camera's colour space has it.
        depth: (H, W) or (H, W, 1), or (B, H, W) or (B, H, W, 1); integers or floats. Holes are 0 or less, NaN, and
            masked values.
        depth_scale: metres per unit of the depth; 0.001 for millimetres, where Open3D and ROS say 1000. Integers need
            it; default of floats: 1.
        optics: the camera. Default: ``TiDyOptics`` with five random masks, the same ones in every call.
        color: order of the three channels of image and capture; ``cv2.imread`` gives ``"bgr"``.
        seed: of the sensor's noise. Default: drawn from torch's global generator.
        holes: ``"fill"`` fills holes of the depth from the nearest known pixel, as :func:`kornia_tidy.data.fill_holes`
            does; ``"error"`` leaves them to the camera. ``fill_holes(depth)`` also returns where they were.
        lens: a real lens in front of the default masks, or its name; ``optics`` has its own.
        field_center: where the middle of the picture lies from the lens's axis, y and x in sensor pixels: (2,), or
            (B, 2).

    Returns:
        The capture, in the layout, data type and colour order of the image; integers are rounded.

    Raises:
        TypeError: if an argument is not an array, or has another data type.
        ValueError: if shapes do not fit, a value is out of range, a depth is not positive, integers come without
            ``depth_scale``, it is units per metre, or the image is a masked array with masked values.

    Convention:
        - Nothing is differentiated: gradients need tensors and :class:`~kornia_tidy.TiDyOptics`.

    Example:
        >>> bgr = np.full((32, 48, 3), (255, 128, 0), np.uint8)
        >>> millimetres = np.full((32, 48), 600, np.uint16)
        >>> capture = simulate(bgr, millimetres, depth_scale=0.001, seed=0)
        >>> capture.shape, capture.dtype
        ((32, 48, 3), dtype('uint8'))
    """
    optics = lens_optics(optics, lens, _default_optics)
    check_choice("holes", holes, HOLES)
    pixels = to_tensor(unmasked("image", image), color, light=optics.color_space == "linear")
    metres = depth_to_tensor(depth, depth_scale)
    if metres.shape[0] != pixels.shape[0] or metres.shape[-2:] != pixels.shape[-2:]:
        raise ValueError(f"depth must have the rows, columns and batch of the image {image.shape}, got {depth.shape}")
    if fills_holes(optics, holes):
        metres, _ = fill_holes(metres)
    generator = None if seed is None else torch.Generator().manual_seed(checked_seed(seed))
    with torch.no_grad():
        coded = optics(pixels, metres, generator=generator, field_center=field_center)
    return _like(coded, image, color)


def reconstruct(
    capture: NDArray[Any],
    system: TiDyOptics | PSFBank | TrainedSystem | LightHead | str | os.PathLike[str] = "joint-uncertain",
    *,
    color: Color = "bgr",
    linear: bool = False,
    memory_budget: int = 512 << 20,
) -> Reconstructed:
    """Reconstruct all-in-focus image and depth from captures in arrays, in tiles that fit the memory.

    Args:
        capture: (H, W), (H, W, 3) or, as a batch, (B, H, W, 1) or (B, H, W, 3); uint8, uint16, or float32 in [0, 1].
        system: the camera or the trained system of the captures. The network any-camera restores captures of a
            :class:`~kornia_tidy.TiDyOptics`, of a saved camera's file, and of a :class:`~kornia_tidy.PSFBank`:
            its noise is measured in the first capture. A trained system is a name of
            :data:`~kornia_tidy.reconstruction.pretrained.PRETRAINED`, or an argument or result of
            :func:`~kornia_tidy.reconstruction.hub.from_pretrained`. For many calls with a system of your
            own, a :class:`~kornia_tidy.reconstruction.light_head.LightHead` of it saves the preparation.
        color: order of the three channels of capture and image.
        linear: True if captures hold linear light, False if they are encoded as sRGB.
        memory_budget: see :func:`~kornia_tidy.reconstruction.tiled.reconstruct_tiled`.

    Returns:
        Image and depth, None for a map that the system was not trained for. A warning tells what was repaired in a
        capture, and what contradicts the noise or encoding told of it, such as linear light taken for sRGB.

    Raises:
        TypeError: if an argument is not an array, or has another data type.
        ValueError: if the shape or a value is not as above.

    Example:
        >>> capture = np.zeros((32, 48, 3), np.uint16)
        >>> image, depth = reconstruct(capture)
        >>> image.shape, image.dtype, depth.shape, depth.dtype
        ((32, 48, 3), dtype('uint16'), (32, 48), dtype('float32'))
        >>> image, depth = reconstruct(capture, TiDyOptics(fidelity="draft"))  # masks that no network was trained with
        >>> image.shape, depth
        ((32, 48, 3), None)
    """
    pixels = to_tensor(unmasked("capture", capture), color)
    check_positive("memory_budget", memory_budget, "bytes")
    if not len(pixels):
        raise ValueError(f"captures must be one or more, got shape {capture.shape}")
    light = pixels if linear else rgb_to_linear_rgb(pixels.expand(-1, 3, -1, -1))
    if isinstance(system, PSFBank):
        system = any_camera_system(system, sensor_of(light[0]))
    head = _light_head(system)
    found = [reconstruct_light(head, one, memory_budget=memory_budget) for one in light]
    for note in dict.fromkeys(note for one in found for note in one.notes):
        warnings.warn(f"capture: {note}", stacklevel=2)
    images = [one.image for one in found if one.image is not None]
    depths = [one.depth[0] for one in found if one.depth is not None]
    like = capture[..., None] if capture.ndim == 2 else capture  # a grey capture too becomes an image of three channels
    near = torch.stack(depths).numpy() if depths else None
    return Reconstructed(
        _like(torch.stack(images), like, color) if images else None,
        near if near is None or capture.ndim == 4 else near[0],
    )


def to_tensor(image: NDArray[Any], color: Color = "bgr", light: bool = False) -> Tensor:
    """Return arrays of images as a tensor (B, C, H, W) in RGB, float32; integers are scaled to [0, 1].

    Args:
        image: as for :func:`simulate`.
        color: order of three channels.
        light: whether floats above 1 are allowed, as linear light may be.

    Raises:
        TypeError: if it is not an array, or has another data type.
        ValueError: if the shape or a value is not allowed.

    Example:
        >>> to_tensor(np.array([[[0, 51, 255]]], np.uint8)).flatten().tolist()
        [1.0, 0.20000000298023224, 0.0]
    """
    check_choice("color", color, ("bgr", "rgb"))
    if not isinstance(image, np.ndarray) or image.dtype not in IMAGES:
        kind = image.dtype if isinstance(image, np.ndarray) else described(image)
        raise TypeError(f"image must be an array of uint8, uint16 or float32, got {kind}")
    image = np.asarray(image)
    shape = (*image.shape, 1) if image.ndim == 2 else image.shape
    if len(shape) not in {3, 4} or shape[-1] not in {1, 3} or 0 in shape[-3:]:
        raise ValueError(f"image must have shape {SHAPES}, got {image.shape}{_shape_remedy(image)}")
    if image.dtype == np.float32:
        lowest, highest = (float(image.min()), float(image.max())) if image.size else (0.0, 0.0)
        if not (lowest >= 0 and (highest <= 1 or (light and np.isfinite(highest)))):  # True for NaN
            remedy = ": divide by 255, or give uint8" if 1 < highest <= 255 and lowest >= 0 else ""
            limits = "be finite and not negative" if light else "lie in [0, 1]"
            raise ValueError(f"a float32 image must {limits}, found {lowest:.9g} to {highest:.9g}{remedy}")
    pixels = image_tensor(image if color == "rgb" else image.reshape(shape)[..., ::-1])
    return pixels if pixels.ndim == 4 else pixels[None]


def depth_to_tensor(depth: NDArray[Any], depth_scale: float | None = None) -> Tensor:
    """Return arrays of depths in metres as a tensor (B, 1, H, W), float32; 0 where a masked array is masked.

    Args:
        depth: as for :func:`simulate`.
        depth_scale: metres per unit. None: floats are metres.

    Raises:
        TypeError: if it is not an array of integers or floats.
        ValueError: if the shape is not allowed, integers come without a scale, or it is units per metre.

    Example:
        >>> depth_to_tensor(np.array([[0, 500, 2000]], np.uint16), 0.001)
        tensor([[[[0.0000, 0.5000, 2.0000]]]])
    """
    if not isinstance(depth, np.ndarray) or depth.dtype.kind not in "uif":
        kind = depth.dtype if isinstance(depth, np.ndarray) else described(depth)
        raise TypeError(f"depth must be an array of integers or floats, got {kind}")
    depth = np.asarray(np.ma.filled(depth, 0))
    maps = depth[..., None] if depth.ndim == 3 and depth.shape[2] != 1 else depth
    if depth.ndim not in {2, 3, 4} or 0 in depth.shape[-2:] or (depth.ndim == 4 and depth.shape[3] != 1):
        raise ValueError(f"depth must have shape (H, W) or (H, W, 1), or (B, H, W) or (B, H, W, 1), got {depth.shape}")
    metres = depth_tensor(maps, depth_scale).float()
    return metres if metres.ndim == 4 else metres[None]


def _like(images: Tensor, array: NDArray[Any], color: Color) -> NDArray[Any]:
    """Return images (B, C, H, W) in the layout, data type and colour order of an array."""
    images = images if array.ndim == 4 else images[0]
    return like_image(images.flip(-3) if color == "bgr" else images, array)


@lru_cache(maxsize=4)
def _default_optics(lens: Lens | str | None) -> TiDyOptics:
    return TiDyOptics(PixelwiseMask(5, generator=torch.Generator().manual_seed(0)), **lens_parts(lens))


def _light_head(system: Any) -> LightHead:
    """Return the network of a system for linear light."""
    if isinstance(system, LightHead):
        return system
    if isinstance(system, str) and system in (*PRETRAINED, *REPLACED):
        return _shipped(system)
    if isinstance(system, (str, os.PathLike)):
        file = os.path.isfile(system)
        system = saved_system(system) if file else from_pretrained(system)
    if isinstance(system, TiDyOptics):
        system = any_camera_system(system)
    kinds = "a TiDyOptics, a PSFBank, a TrainedSystem, a LightHead, a name, a file or a folder"
    check_part("system", system, TrainedSystem, kinds)
    return LightHead(system)


@cache
def _shipped(name: str) -> LightHead:
    return LightHead(load_pretrained(name))


def _shape_remedy(image: NDArray[Any]) -> str:
    """Return the remedy for usual other layouts: alpha, channels first, a batch of grey images."""
    if image.ndim == 3 and image.shape[2] == 4:
        return ": drop alpha with image[..., :3]"
    if image.ndim in {3, 4} and image.shape[-3] in {1, 3}:
        return f": channels come last, np.moveaxis(image, {image.ndim - 3}, -1)"
    return ": a batch of grey images is image[..., None]" if image.ndim == 3 and image.size else ""
