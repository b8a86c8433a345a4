"""Occlusion by direct convolution with SIMD vectors, sample by sample.

A block of 8 x 16 pixels (in float32) meets the layers in its window, each only in the rows and columns where it is. All
that is added up is positive, so float32 is enough: the relative error of every sum is small, however small the
normaliser that it becomes. Whole weights along runs of pixels are not even convolved: their blur is known from where
runs begin and end. The work is done in C (``occlusion.c``), see :mod:`kornia_tidy.kernels.build`. Gradients are made by
tiles.
"""

from __future__ import annotations

from torch import Tensor

from kornia_tidy.kernels.build import REALS, compiled
from kornia_tidy.kernels.occlusion_ops import SMALLEST_SIDE, SOURCE, count_work, smallest_output
from kornia_tidy.render.scene import LayeredScene

NEGATIVE = 1e-4  # of a PSF: over EPSILON it makes a float32's round-off 1e-5
COUNTED = 12  # bands of blocks in the sample that costs are estimated from


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


def scene_cost(scene: LayeredScene) -> float:
    """Return the time that a scene takes in nanoseconds a channel, see :func:`direct_cost`."""
    index, weight = scene.sorted_layers
    counts = count_work(scene.plane, scene.psfs, index, weight, COUNTED)
    return direct_cost(*counts, max(scene.psfs.shape[-1], SMALLEST_SIDE))


def direct_cost(alone: int, pairs: int, columns: int, edges: int, side: int) -> float:
    r"""Return the time that this takes in nanoseconds a channel, on the core of ``windows_cost``.

    .. math:: A (250 + 3.7 P^2) + (320 + 3 P) N + 2.3 K + 12 E

    Fitted to 7 to 65 pixels a side, nearest and linear layers, flat scenes and noise: within 15 %.

    Args:
        alone: A, pairs of blocks whose window is all of one layer; in float64 blocks are half as wide.
        pairs: N, pairs of another block and a layer present in its window.
        columns: K, columns of PSFs that meet a row of light, or of shared weights.
        edges: E, where runs of whole weights begin and end.
        side: P, of PSFs.

    Example:
        >>> f"{direct_cost(2_139, 21_603, 5_606_383, 534_148, 23) * 3e-6:.0f} ms"  # Aloe in 21 layers
        '97 ms'
    """
    return alone * (250 + 3.7 * side**2) + (320 + 3 * side) * pairs + 2.3 * columns + 12 * edges
