"""Checks of the tensors of a layered scene, which operators share.

Functions named ``new_...`` check an operator's tensors and return the memory of its result, as a fake implementation
does.
"""

from __future__ import annotations

from typing import NoReturn

import torch
from torch import Tensor

from kornia_tidy.kernels.build import REALS
from kornia_tidy.kernels.operators import check


def new_pixels(
    plane: Tensor, psfs: Tensor, layer_index: Tensor, layer_weight: Tensor | None, weight_gradient: bool
) -> Tensor:
    """Return (B, C, H, W) memory for light that is gathered from a plane (B, C, H + P - 1, W + P - 1)."""
    sizes = check_light("plane", plane, "Y X", psfs)
    light = output_of(plane, psfs)
    _check_labels(sizes | {"H": light[2], "W": light[3]}, plane, layer_index, layer_weight)
    if weight_gradient and layer_weight is None:
        raise ValueError("weight_gradient needs a layer_weight, got None")
    return plane.new_empty(light)


def new_plane(pixels: Tensor, psfs: Tensor, layer_index: Tensor, layer_weight: Tensor | None) -> Tensor:
    """Return (B, C, H + P - 1, W + P - 1) zeros for light that is scattered from pixels (B, C, H, W)."""
    sizes = check_light("pixels", pixels, "H W", psfs)
    _check_labels(sizes, pixels, layer_index, layer_weight)
    lost = psfs.shape[-1] - 1
    return pixels.new_zeros(*pixels.shape[:2], pixels.shape[2] + lost, pixels.shape[3] + lost)


def new_psfs(plane: Tensor, pixels: Tensor, layer_index: Tensor, layer_weight: Tensor | None, layers: int) -> Tensor:
    """Return (D, C, P, P) zeros for the sums of a plane (B, C, H + P - 1, W + P - 1) times pixels (B, C, H, W)."""
    sizes = check_light("plane", plane, "Y X")
    lost = plane.shape[-1] - pixels.shape[-1]
    if lost < 0 or lost % 2:
        raise ValueError(f"PSFs must have an odd side of at least 1 pixel, got {lost + 1}")
    sizes |= {"H": plane.shape[2] - lost, "W": plane.shape[3] - lost}
    check(sizes, plane.dtype, pixels=(pixels, "B C H W"))
    _check_labels(sizes, plane, layer_index, layer_weight)
    return plane.new_zeros(layers, plane.shape[1], lost + 1, lost + 1)


def check_light(name: str, light: Tensor, rows_and_columns: str, psfs: Tensor | None = None) -> dict[str, int]:
    """Return the sizes of light, of which only the first may be 0, and of square PSFs with an odd side."""
    if light.dtype not in REALS:
        raise TypeError(f"{name} must be float32 or float64, got {light.dtype}")
    sizes: dict[str, int] = {}
    check(sizes, light.dtype, **{name: (light, f"B C {rows_and_columns}"), "psfs": (psfs, "D C P P")})
    if 0 in light.shape[1:]:
        raise ValueError(f"{name} must be empty along its first axis only, got shape {tuple(light.shape)}")
    if psfs is not None and psfs.shape[-1] % 2 == 0:
        raise ValueError(f"psfs must have an odd side, got {psfs.shape[-1]}")
    return sizes


def output_of(plane: Tensor, psfs: Tensor) -> tuple[int, int, int, int]:
    """Return the shape of the light that a plane gives through PSFs."""
    batch, channels, height, width = plane.shape
    return batch, channels, height - psfs.shape[-1] + 1, width - psfs.shape[-1] + 1


def check_smallest(output: tuple[int, ...], smallest: tuple[int, int]) -> None:
    """Refuse an output (..., H, W) of fewer rows or columns than a block of pixels."""
    height, width = output[-2:]
    if height < smallest[0] or width < smallest[1]:
        raise ValueError(f"the output must have at least {smallest[0]}x{smallest[1]} pixels, got {height}x{width}")


def refuse_layer(layers: int) -> NoReturn:
    """Raise the error of a pixel that lies in none of the layers."""
    raise IndexError(f"a pixel lies in none of the {layers} layers: its depth or defocus is not a number")


def _check_labels(sizes: dict[str, int], light: Tensor, layer_index: Tensor, layer_weight: Tensor | None) -> None:
    check(sizes, torch.int64, layer_index=(layer_index, "B H W"))
    check(sizes, light.dtype, layer_weight=(layer_weight, "B H W"))
