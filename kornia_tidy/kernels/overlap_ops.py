r"""Operators of gather and scatter by transforms of overlapping windows: light, and the gradient of the PSFs. In C.

With the share :math:`w_d` that a pixel takes of layer d, all three are the derivatives of one sum that is linear in the
plane L, in the pixels I and in the PSFs h:

.. math:: T = \sum_{c d y} I_c(y) \, w_d(y) \, (L_c * h_{dc})(y)

:func:`gather_overlap` is its derivative to I, :func:`scatter_overlap` to L and :func:`overlap_psf_gradient` to h.

PSFs may vary over the field, see :class:`~kornia_tidy.kernels.places.Places`: the PSF of a pixel y is then that of its
tile, to first order.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cache
from itertools import count

import torch
from torch import Tensor

from kornia_tidy.kernels.build import KERNELS, load
from kornia_tidy.kernels.operators import call, operator, strided
from kornia_tidy.kernels.places import Places, check_places, fields_of, of_axis
from kornia_tidy.kernels.scene_checks import new_pixels, new_plane, new_psfs, refuse_layer
from kornia_tidy.kernels.window_sides import is_window_size, needed_side, size_step

SOURCE = KERNELS / "overlap.c"


@cache
def window_size(psf_side: int) -> int:
    """Return the side of the windows for PSFs of P pixels: the next that both data types can have from 2.5 P on.

    Larger windows waste less on their overlap, smaller ones hold fewer layers.

    Example:
        >>> [window_size(side) for side in (5, 23, 61, 129)]
        [32, 64, 160, 384]
    """
    step = size_step(torch.float32)
    sizes = count(step * max(1, -(-5 * psf_side // (2 * step))), step)
    return next(size for size in sizes if is_window_size(size, torch.float32))


@operator()
def gather_overlap(
    plane: Tensor,
    psfs: Tensor,
    layer_index: Tensor,
    layer_weight: Tensor | None,
    size: int,
    correlate: bool = False,
    weight_gradient: bool = False,
    places: Sequence[Tensor] | None = None,
) -> Iterator[Tensor]:
    r"""Convolve a plane with the PSFs of each pixel's layers and blend them: operator ``kornia_tidy::gather_overlap``.

    .. math:: I_c = (1 - t) \, (L_c * h_{dc}) + t \, (L_c * h_{d+1,c})

    By overlap-save, in windows that are transformed with the PSFs of the layers of their pixels.

    Args:
        plane: L, (B, C, H + P - 1, W + P - 1) light on a processor, float32 or float64.
        psfs: h, (D, C, P, P) with P odd, of the plane's dtype; with ``places`` (I, J, D, C, P, P).
        layer_index: d, (B, H, W) int64.
        layer_weight: t, share of the next layer in [0, 1], (B, H, W) of the plane's dtype, or None for zero.
        size: side of a window in samples, see :func:`~kornia_tidy.kernels.window_sides.is_window_size`, at least P.
        correlate: with PSFs that are flipped by 180 degrees.
        weight_gradient: return :math:`\partial I_c / \partial t` instead.
        places: :class:`~kornia_tidy.kernels.places.Places` of PSFs that vary over the field. Default: they are the same
            everywhere.

    Returns:
        (B, C, H, W). It has no gradient.

    Raises:
        TypeError: if a data type is not as above.
        ValueError: if shapes or the size do not fit.
        IndexError: if a pixel lies in no layer.
        MemoryError: if memory for the spectra is missing.
        NotBuiltError: if the source cannot be compiled.
    """
    pixels = new_pixels(plane, of_axis(psfs, places), layer_index, layer_weight, weight_gradient)
    _check_size(size, psfs.shape[-1], psfs.dtype)
    yield pixels
    labels, options = (layer_index, layer_weight), (correlate, weight_gradient)
    _fill("gather", pixels, psfs.shape[-4:], labels, size, *options, places, plane=plane, psfs=psfs)


@operator()
def scatter_overlap(
    pixels: Tensor,
    psfs: Tensor,
    layer_index: Tensor,
    layer_weight: Tensor | None,
    size: int,
    correlate: bool = False,
    places: Sequence[Tensor] | None = None,
) -> Iterator[Tensor]:
    """Spread the light of pixels by the PSFs of their layers: the transpose of :func:`gather_overlap`, by overlap-add.

    Args:
        pixels: I, (B, C, H, W) on a processor, float32 or float64.
        psfs: and the other arguments as there.
        layer_index: (B, H, W).
        layer_weight: (B, H, W), or None.
        size: side of a window in samples.
        correlate: with PSFs that are flipped. The gradient of :func:`gather_overlap` with respect to its plane takes
            the opposite value.
        places: as there.

    Returns:
        (B, C, H + P - 1, W + P - 1) light, added in the same order every time. It has no gradient. Errors are those of
        :func:`gather_overlap`.
    """
    plane = new_plane(pixels, of_axis(psfs, places), layer_index, layer_weight)
    _check_size(size, psfs.shape[-1], psfs.dtype)
    yield plane
    labels, options = (layer_index, layer_weight), (correlate, False)
    _fill("scatter", plane, psfs.shape[-4:], labels, size, *options, places, pixels=pixels, psfs=psfs)


@operator()
def overlap_psf_gradient(
    plane: Tensor,
    pixels: Tensor,
    layer_index: Tensor,
    layer_weight: Tensor | None,
    layers: int,
    size: int,
    correlate: bool = False,
    places: Sequence[Tensor] | None = None,
) -> Iterator[Tensor]:
    """Correlate a plane with each layer's pixels: the gradient of :func:`gather_overlap` with respect to the PSFs.

    Args:
        plane: (B, C, H + P - 1, W + P - 1) light.
        pixels: (B, C, H, W) gradient of what :func:`gather_overlap` returns.
        layer_index: (B, H, W), as there.
        layer_weight: (B, H, W), as there, or None.
        layers: number of layers D.
        size: side of a window in samples.
        correlate: as there.
        places: as there.

    Returns:
        (D, C, P, P), or with ``places`` (I, J, D, C, P, P), added in the same order every time with as many threads. It
        has no gradient. Errors are those of :func:`gather_overlap`.
    """
    found = new_psfs(plane, pixels, layer_index, layer_weight, layers)
    _check_size(size, found.shape[-1], found.dtype)
    if places:
        nodes = Places(*places).row_weights.shape[-1], Places(*places).column_weights.shape[-1]
        check_places(places, nodes)
        found = found.new_zeros(*nodes, *found.shape)
    yield found
    labels, options = (layer_index, layer_weight), (correlate, False)
    _fill("correlate", found, found.shape[-4:], labels, size, *options, places, plane=plane, pixels=pixels)


def _check_size(size: int, side: int, dtype: torch.dtype) -> None:
    if size < side or not is_window_size(size, dtype):
        raise ValueError(
            f"size must be at least the PSFs' side {side}, a multiple of {size_step(dtype)} and without prime factors "
            f"but 2, 3 and 5, got {size}"
        )


def _fill(
    function: str,
    out: Tensor,
    of_psfs: Sequence[int],
    labels: tuple[Tensor, Tensor | None],
    size: int,
    correlate: bool,
    weight_gradient: bool,
    places: Sequence[Tensor] | None,
    plane: Tensor | None = None,
    pixels: Tensor | None = None,
    psfs: Tensor | None = None,
) -> None:
    """Call a function of overlap.c that writes to ``out``, from PSFs (..., D, C, P, P)."""
    (images, height, width), (layers, channels, side, _) = labels[0].shape, of_psfs
    if not out.numel() or not images:
        return
    step, most = size_step(out.dtype), size - side + 1
    field = fields_of(places, (height, width), (most, most), out.dtype)
    edges = (Places(*places).row_edges, Places(*places).column_edges) if places else ()
    largest = [int(axis.diff().max()) for axis in edges] or [height, width]
    window = needed_side(size, largest[0], side, step // 2), needed_side(size, largest[1], side, step)
    origin = (side - 1) * (correlate == (function == "scatter"))
    numbers = images, channels, height, width, layers, side, *window, origin, correlate, weight_gradient
    light, layer = (strided(plane), strided(pixels)), (strided(labels[0], 3), strided(labels[1], 3))
    if call(getattr(load(SOURCE, out.dtype), function), *numbers, *light, *layer, psfs, out, *field):
        refuse_layer(layers)
