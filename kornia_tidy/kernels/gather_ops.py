"""Operator of gather by direct convolution, in C: through PSFs of few pixels, discs and other PSFs of few terms.

The renderer makes the gradients of light and PSFs by the windows of ``overlap_ops.py``.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor
from torch.nn.functional import pad

from kornia_tidy.kernels.build import KERNELS, load
from kornia_tidy.kernels.operators import call, operator, strided
from kornia_tidy.kernels.scene_checks import check_smallest, new_pixels, refuse_layer
from kornia_tidy.kernels.window_sides import size_step

SOURCE = KERNELS / "direct.c"
STRIP_ROWS = 4  # of a strip of pixels, see direct.c


@operator()
def gather_direct(
    plane: Tensor,
    psfs: Tensor,
    layer_index: Tensor,
    layer_weight: Tensor | None = None,
    correlate: bool = False,
    weight_gradient: bool = False,
) -> Iterator[Tensor]:
    r"""Convolve a plane with the PSFs of each pixel's layers and blend them: operator ``kornia_tidy::gather_direct``.

    .. math:: I_c = (1 - t) \, (L_c * h_{dc}) + t \, (L_c * h_{d+1,c})

    Args:
        plane: L, (B, C, H + P - 1, W + P - 1) light on a processor, float32 or float64.
        psfs: h, (D, C, P, P) with P odd, of the plane's dtype. Rounding through discs is relative to the largest light
            in the P + 16 rows around a pixel, as sums of columns have it.
        layer_index: d, (B, H, W) int64.
        layer_weight: t, share of the next layer in [0, 1], (B, H, W) of the plane's dtype, or None for zero.
        correlate: with PSFs that are flipped by 180 degrees.
        weight_gradient: return :math:`\partial I_c / \partial t` instead.

    Returns:
        (B, C, H, W). It has no gradient.

    Raises:
        TypeError: if a data type is not as above.
        ValueError: if shapes do not fit, or the output is smaller than a block of 4 x 32 (float64: 4 x 16) pixels.
        IndexError: if a pixel lies in no layer.
        NotBuiltError: if the source cannot be compiled.
    """
    light = new_pixels(plane, psfs, layer_index, layer_weight, weight_gradient)
    check_smallest(light.shape, smallest_output(light.dtype))
    yield light
    labels = strided(layer_index, 3), strided(layer_weight, 3)
    planes = strided(plane), (psfs if correlate else psfs.flip((-2, -1))).mT
    numbers = *light.shape, *psfs.shape[::3], weight_gradient
    if call(load(SOURCE, light.dtype).mix, *numbers, *planes, *labels, light):
        refuse_layer(len(psfs))


def count_terms(psfs: Tensor) -> int:
    """Return the number of terms of all PSFs: as direct.c counts them, except that all PSFs take them of the same kind.

    A disc's columns are runs of one value. Sums of the light down each column give a run from its two ends.

    Args:
        psfs: (D, C, P, P).

    Example:
        >>> count_terms(torch.ones(1, 1, 33, 33)), count_terms(torch.rand(1, 1, 33, 33))
        (66, 1089)
    """
    return min(int(psfs.count_nonzero()), int(pad(psfs, (0, 0, 1, 1)).diff(dim=-2).count_nonzero()))


def smallest_output(dtype: torch.dtype) -> tuple[int, int]:
    """Return the rows and columns of a block, below which an image is too small.

    Example:
        >>> smallest_output(torch.float32), smallest_output(torch.float64)
        ((4, 32), (4, 16))
    """
    return STRIP_ROWS, size_step(dtype)
