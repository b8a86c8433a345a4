"""Occlusion by direct convolution with SIMD vectors, sample by sample.

A block of 8 vectors (in float32 8 x 16 pixels, where they have 64 bytes) meets the layers in its window, each only in
the rows and columns where it is. All that is added up is positive, so float32 is enough: the relative error of every
sum is small, however small the
normaliser that it becomes. Whole weights along runs of pixels are not even convolved: their blur is known from where
runs begin and end. The work is done in C (``occlusion.c``), see :mod:`kornia_tidy.kernels.build`. Gradients of PSFs
and stray light are made in the same way, those of image and depth by tiles.
"""

from __future__ import annotations

import math

from torch import Tensor

from kornia_tidy.kernels.build import REALS, compiled
from kornia_tidy.kernels.occlusion_ops import SMALLEST_SIDE, SOURCE, count_work, smallest_output
from kornia_tidy.render.cost_model import DirectOcclusionWork
from kornia_tidy.render.scene import LayeredScene

NEGATIVE = 1e-4  # of a PSF: over EPSILON it makes a float32's round-off 1e-5
COUNTED, FEWEST_COUNTED = 12, 3  # bands of blocks that are counted to know the work


def refusal(output_size: tuple[int, ...], psfs: Tensor) -> str | None:
    """Return why a scene with occlusion cannot be rendered directly, or None if it can.

    Sums keep their relative accuracy only where what is added up is positive.

    Args:
        output_size: height and width.
        psfs: (D, C, P, P) of the light's dtype.
    """
    if psfs.device.type != "cpu":
        return f"direct convolution runs on processors, and the PSFs are on {psfs.device.type!r}"
    if psfs.dtype not in REALS:
        return f"direct convolution is in float32 or float64, and the PSFs in {psfs.dtype}"
    smallest = smallest_output(psfs.dtype)
    if output_size[0] < smallest[0] or output_size[1] < smallest[1]:
        size = "x".join(map(str, output_size))
        return f"direct occlusion needs an output of at least {smallest[0]}x{smallest[1]} pixels, got {size}"
    lowest = float(psfs.detach().clamp(max=0).sum((-2, -1)).min())
    if lowest < -NEGATIVE:
        return f"direct occlusion needs PSFs without negative values, got one with {lowest:.1e} of its light below zero"
    if compiled(SOURCE, psfs.dtype) is None:
        return "direct convolution needs a C compiler (see `kornia-tidy info`)"
    return None


def can_go_directly(plane: Tensor, psfs: Tensor) -> bool:
    """Return whether a plane (B, C, H + P - 1, W + P - 1) can be rendered directly, see :func:`refusal`."""
    output_size = tuple(side - psfs.shape[-1] + 1 for side in plane.shape[-2:])
    return psfs.dtype == plane.dtype and refusal(output_size, psfs) is None


def scene_work(scene: LayeredScene) -> DirectOcclusionWork:
    """Return the work for a scene, counted in every few bands of blocks."""
    index, weight = scene.sorted_layers
    counts = count(scene.plane, scene.psfs, index, weight)
    (batch, channels), pixels = scene.image.shape[:2], math.prod(scene.output_size)
    side, itemsize = max(scene.psfs.shape[-1], SMALLEST_SIDE), scene.image.element_size()
    return DirectOcclusionWork(batch * pixels, *counts, side, len(scene.psfs), channels, itemsize)


def count(plane: Tensor, psfs: Tensor, layer_index: Tensor, layer_weight: Tensor | None) -> tuple[int, int, int, int]:
    """Return the counts of a :class:`~kornia_tidy.render.cost_model.DirectOcclusionWork`, from every few bands."""
    # Small PSFs are rendered in little more time than it takes to count, and are the fastest by far.
    bands = min(COUNTED, max(FEWEST_COUNTED, max(psfs.shape[-1], SMALLEST_SIDE) // 4))
    return count_work(plane, psfs, layer_index, layer_weight, bands)
