"""Checks of the tensors of a layered scene, which operators share.

Functions named ``new_...`` check an operator's tensors and return the memory of its result, as a fake implementation
does.
"""

from __future__ import annotations

from typing import NoReturn

import torch
from torch import Tensor

from kornia_tidy.kernels.build import REALS


def new_pixels(
    plane: Tensor, psfs: Tensor, layer_index: Tensor, layer_weight: Tensor | None, weight_gradient: bool
) -> Tensor:
    """Return (B, C, H, W) memory for light that is gathered from a plane (B, C, H + P - 1, W + P - 1)."""
    check_light("plane", plane)
    check_psfs(psfs, plane)
    lost = psfs.shape[-1] - 1
    pixels = (plane.shape[0], plane.shape[2] - lost, plane.shape[3] - lost)
    _check_labels(plane, layer_index, layer_weight, pixels)
    if weight_gradient and layer_weight is None:
        raise ValueError("weight_gradient needs a layer_weight, got None")
    return plane.new_empty(plane.shape[0], plane.shape[1], *pixels[1:])


def new_plane(pixels: Tensor, psfs: Tensor, layer_index: Tensor, layer_weight: Tensor | None) -> Tensor:
    """Return (B, C, H + P - 1, W + P - 1) zeros for light that is scattered from pixels (B, C, H, W)."""
    check_light("pixels", pixels)
    check_psfs(psfs, pixels)
    _check_labels(pixels, layer_index, layer_weight, (pixels.shape[0], *pixels.shape[2:]))
    lost = psfs.shape[-1] - 1
    return pixels.new_zeros(*pixels.shape[:2], pixels.shape[2] + lost, pixels.shape[3] + lost)


def new_psfs(plane: Tensor, pixels: Tensor, layer_index: Tensor, layer_weight: Tensor | None, layers: int) -> Tensor:
    """Return (D, C, P, P) zeros for the sums of a plane (B, C, H + P - 1, W + P - 1) times pixels (B, C, H, W)."""
    check_light("plane", plane)
    check_light("pixels", pixels)
    check_dtypes(plane, pixels=pixels)
    lost = plane.shape[-1] - pixels.shape[-1]
    if lost < 0 or lost % 2:
        raise ValueError(f"PSFs must have an odd side of at least 1 pixel, got {lost + 1}")
    check_shape("pixels", pixels, (*plane.shape[:2], plane.shape[2] - lost, plane.shape[3] - lost))
    _check_labels(plane, layer_index, layer_weight, (pixels.shape[0], *pixels.shape[2:]))
    return plane.new_zeros(layers, plane.shape[1], lost + 1, lost + 1)


def check_light(name: str, light: Tensor) -> None:
    """Refuse all but real numbers in four dimensions. Only the first may be empty."""
    if light.dtype not in REALS:
        raise TypeError(f"{name} must be float32 or float64, got {light.dtype}")
    if light.ndim != 4 or 0 in light.shape[1:]:
        raise ValueError(f"{name} must have four dimensions, only the first may be empty, got {tuple(light.shape)}")


def check_dtypes(light: Tensor, **tensors: Tensor | None) -> None:
    """Refuse tensors of another data type than the light."""
    for name, tensor in tensors.items():
        if tensor is not None and tensor.dtype != light.dtype:
            raise TypeError(f"{name} must be of the light's dtype {light.dtype}, got {tensor.dtype}")


def check_shape(name: str, tensor: Tensor | None, *allowed: tuple[int, ...]) -> None:
    """Refuse a tensor of another shape than those allowed."""
    if tensor is not None and tuple(tensor.shape) not in allowed:
        shapes = " or ".join(map(str, allowed))
        raise ValueError(f"{name} must have shape {shapes}, got {tuple(tensor.shape)}")


def check_psfs(psfs: Tensor, light: Tensor) -> None:
    """Refuse PSFs that are not square with an odd side, or not as many as the light's channels."""
    check_dtypes(light, psfs=psfs)
    if psfs.ndim != 4 or psfs.shape[1] != light.shape[1] or psfs.shape[2] != psfs.shape[3] or psfs.shape[3] % 2 == 0:
        raise ValueError(f"psfs must have shape (D, {light.shape[1]}, P, P) with P odd, got {tuple(psfs.shape)}")


def check_smallest(output: tuple[int, ...], smallest: tuple[int, int]) -> None:
    """Refuse an output (..., H, W) of fewer rows or columns than a block of pixels."""
    height, width = output[-2:]
    if height < smallest[0] or width < smallest[1]:
        raise ValueError(f"the output must have at least {smallest[0]}x{smallest[1]} pixels, got {height}x{width}")


def refuse_layer(layers: int) -> NoReturn:
    """Raise the error of a pixel that lies in none of the layers."""
    raise IndexError(f"a pixel lies in none of the {layers} layers: its depth or defocus is not a number")


def _check_labels(light: Tensor, layer_index: Tensor, layer_weight: Tensor | None, pixels: tuple[int, ...]) -> None:
    if layer_index.dtype != torch.int64:
        raise TypeError(f"layer_index must be int64, got {layer_index.dtype}")
    check_dtypes(light, layer_weight=layer_weight)
    check_shape("layer_index", layer_index, pixels)
    check_shape("layer_weight", layer_weight, pixels)
