r"""Operators of gather and scatter by transforms of overlapping windows: light, and the gradient of the PSFs. In C.

With the share :math:`w_d` that a pixel takes of layer d, all three are the derivatives of one sum that is linear in the
plane L, in the pixels I and in the PSFs h:

.. math:: T = \sum_{c d y} I_c(y) \, w_d(y) \, (L_c * h_{dc})(y)

:func:`gather_overlap` is its derivative to I, :func:`scatter_overlap` to L and :func:`overlap_psf_gradient` to h.

PSFs may vary over the field, see :class:`~kornia_tidy.kernels.places.Places`: the PSF of a pixel y is then that of its
tile, to first order.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from functools import cache
from itertools import count
from typing import Any

import torch
from torch import Tensor

from kornia_tidy.kernels.build import KERNELS, load
from kornia_tidy.kernels.operators import Parameters, define
from kornia_tidy.kernels.places import PLACES, Places, check_places, of_axis, parameters_of
from kornia_tidy.kernels.scene_checks import new_pixels, new_plane, new_psfs, refuse_layer
from kornia_tidy.kernels.window_sides import is_window_size, needed_side, size_step

SOURCE = KERNELS / "overlap.c"
NO_LAYER, NO_MEMORY = 1, 2  # status of the functions


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


def gather_overlap(
    plane: Tensor,
    psfs: Tensor,
    layer_index: Tensor,
    layer_weight: Tensor | None,
    size: int,
    *,
    correlate: bool = False,
    weight_gradient: bool = False,
    places: Sequence[Tensor] = (),
) -> Tensor:
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
    return torch.ops.kornia_tidy.gather_overlap(
        plane, psfs, layer_index, layer_weight, size, correlate, weight_gradient, list(places)
    )


def scatter_overlap(
    pixels: Tensor,
    psfs: Tensor,
    layer_index: Tensor,
    layer_weight: Tensor | None,
    size: int,
    *,
    correlate: bool = False,
    places: Sequence[Tensor] = (),
) -> Tensor:
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
    labels = layer_index, layer_weight
    return torch.ops.kornia_tidy.scatter_overlap(pixels, psfs, *labels, size, correlate, list(places))


def overlap_psf_gradient(
    plane: Tensor,
    pixels: Tensor,
    layer_index: Tensor,
    layer_weight: Tensor | None,
    layers: int,
    size: int,
    *,
    correlate: bool = False,
    places: Sequence[Tensor] = (),
) -> Tensor:
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
    labels = layer_index, layer_weight
    return torch.ops.kornia_tidy.overlap_psf_gradient(plane, pixels, *labels, layers, size, correlate, list(places))


class _Tiles(Parameters):
    """The struct ``tiles`` in overlap.c."""

    _fields_ = (
        *((name, ctypes.c_int64) for name in ("images", "channels", "height", "width", "layers", "side", "threads")),
        *((name, ctypes.c_int64) for name in ("rows", "columns", "origin", "correlate", "weight_gradient")),
        *((name, ctypes.c_int64) for name in ("plane_image", "plane_channel", "plane_row")),
        *((name, ctypes.c_int64) for name in ("pixels_image", "pixels_channel", "pixels_row")),
        *((name, ctypes.c_int64) for name in ("index_image", "index_row", "weight_image", "weight_row")),
        *((name, ctypes.c_void_p) for name in ("psfs", "index", "weight", "plane", "pixels", "out")),
        *PLACES,
    )


def _call(
    function: str,
    out: Tensor,
    like_psfs: Tensor,
    labels: tuple[Tensor, Tensor | None],
    size: int,
    correlate: bool,
    weight_gradient: bool,
    places: list[Tensor],
    **tensors: Tensor,
) -> Tensor:
    """Call a function of overlap.c that writes to ``out``, and return it."""
    (images, height, width), (layers, channels, side, _) = labels[0].shape, like_psfs.shape[-4:]
    step, largest, own = size_step(out.dtype), (height, width), {}
    if places:
        most = size - side + 1
        own, more = parameters_of(places, (height, width), (most, most), out.dtype)
        largest = int(more["row_edges"].diff().max()), int(more["column_edges"].diff().max())
        tensors |= more
    tiles = _Tiles(
        images=images,
        channels=channels,
        height=height,
        width=width,
        layers=layers,
        side=side,
        rows=needed_side(size, largest[0], side, step // 2),
        columns=needed_side(size, largest[1], side, step),
        origin=(side - 1) * (correlate == (function == "scatter")),
        correlate=correlate,
        weight_gradient=weight_gradient,
        **own,
    )
    tiles.point_to(index=labels[0], weight=labels[1], out=out, **tensors)
    status = getattr(load(SOURCE, out.dtype), function)(ctypes.byref(tiles)) if images and out.numel() else 0
    if status == NO_LAYER:
        refuse_layer(layers)
    if status == NO_MEMORY:
        raise MemoryError(f"no memory for the spectra of {layers} PSFs in windows of {size}x{size} samples")
    return out


def _check_size(size: int, side: int, dtype: torch.dtype) -> None:
    if size < side or not is_window_size(size, dtype):
        raise ValueError(
            f"size must be at least the PSFs' side {side}, a multiple of {size_step(dtype)} and without prime factors "
            f"but 2, 3 and 5, got {size}"
        )


def _new_pixels(
    plane: Tensor,
    psfs: Tensor,
    index: Tensor,
    weight: Tensor | None,
    size: int,
    correlate: bool,
    weight_gradient: bool,
    places: list[Tensor],
) -> Tensor:
    out = new_pixels(plane, of_axis(psfs, places), index, weight, weight_gradient)
    _check_size(size, psfs.shape[-1], psfs.dtype)
    return out


def _new_plane(
    pixels: Tensor,
    psfs: Tensor,
    index: Tensor,
    weight: Tensor | None,
    size: int,
    correlate: bool,
    places: list[Tensor],
) -> Tensor:
    out = new_plane(pixels, of_axis(psfs, places), index, weight)
    _check_size(size, psfs.shape[-1], psfs.dtype)
    return out


def _new_psfs(
    plane: Tensor,
    pixels: Tensor,
    index: Tensor,
    weight: Tensor | None,
    layers: int,
    size: int,
    correlate: bool,
    places: list[Tensor],
) -> Tensor:
    out = new_psfs(plane, pixels, index, weight, layers)
    _check_size(size, out.shape[-1], out.dtype)
    if not places:
        return out
    nodes = Places(*places).row_weights.shape[-1], Places(*places).column_weights.shape[-1]
    check_places(places, nodes)
    return out.new_zeros(*nodes, *out.shape)


def _gather(plane: Tensor, psfs: Tensor, *rest: Any) -> Tensor:
    index, weight, *options = rest
    out = _new_pixels(plane, psfs, *rest)
    return _call("gather", out, psfs, (index, weight), *options, plane=plane, psfs=psfs)


def _scatter(pixels: Tensor, psfs: Tensor, *rest: Any) -> Tensor:
    index, weight, size, correlate, places = rest
    out = _new_plane(pixels, psfs, *rest)
    return _call("scatter", out, psfs, (index, weight), size, correlate, False, places, pixels=pixels, psfs=psfs)


def _psf_gradient(plane: Tensor, pixels: Tensor, *rest: Any) -> Tensor:
    index, weight, _, size, correlate, places = rest
    out = _new_psfs(plane, pixels, *rest)
    return _call("correlate", out, out, (index, weight), size, correlate, False, places, plane=plane, pixels=pixels)


define(
    "gather_overlap",
    "(Tensor plane, Tensor psfs, Tensor layer_index, Tensor? layer_weight, SymInt size, bool correlate,"
    " bool weight_gradient, Tensor[] places) -> Tensor",
    _gather,
    _new_pixels,
)
define(
    "scatter_overlap",
    "(Tensor pixels, Tensor psfs, Tensor layer_index, Tensor? layer_weight, SymInt size, bool correlate,"
    " Tensor[] places) -> Tensor",
    _scatter,
    _new_plane,
)
define(
    "overlap_psf_gradient",
    "(Tensor plane, Tensor pixels, Tensor layer_index, Tensor? layer_weight, SymInt layers, SymInt size,"
    " bool correlate, Tensor[] places) -> Tensor",
    _psf_gradient,
    _new_psfs,
)
