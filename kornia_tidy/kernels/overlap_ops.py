r"""Operators of gather and scatter by transforms of overlapping windows: light, and the gradient of the PSFs. In C.

With the share :math:`w_d` that a pixel takes of layer d, all three are the derivatives of one sum that is linear in the
plane L, in the pixels I and in the PSFs h:

.. math:: T = \sum_{c d y} I_c(y) \, w_d(y) \, (L_c * h_{dc})(y)

:func:`gather_overlap` is its derivative to I, :func:`scatter_overlap` to L and :func:`overlap_psf_gradient` to h. So
they are each other's derivatives, of any order.

Operators are defined by schema, as ``torch.library.custom_op`` would import the compiler on the first call (3 s).
"""

from __future__ import annotations

import ctypes
from functools import cache
from itertools import count
from typing import Any

import torch
from torch import Tensor

from kornia_tidy.kernels.build import KERNELS, REALS, load
from kornia_tidy.kernels.gather_ops import rows_in_memory
from kornia_tidy.kernels.window_sides import is_window_size, needed_side, size_step

SOURCE = KERNELS / "overlap.c"
NO_LAYER, NO_MEMORY = 1, 2  # what the functions return

for _schema in (
    "gather_overlap(Tensor plane, Tensor psfs, Tensor layer_index, Tensor? layer_weight, SymInt size, bool correlate,"
    " bool weight_gradient) -> Tensor",
    "scatter_overlap(Tensor pixels, Tensor psfs, Tensor layer_index, Tensor? layer_weight, SymInt size, bool correlate,"
    " bool weight_gradient) -> Tensor",
    "overlap_psf_gradient(Tensor plane, Tensor pixels, Tensor layer_index, Tensor? layer_weight, SymInt layers,"
    " SymInt size, bool correlate, bool weight_gradient) -> Tensor",
):
    torch.library.define(f"kornia_tidy::{_schema.partition('(')[0]}", "(" + _schema.partition("(")[2])


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
) -> Tensor:
    r"""Convolve a plane with the PSFs of each pixel's layers and blend them: operator ``kornia_tidy::gather_overlap``.

    .. math:: I_c = (1 - t) \, (L_c * h_{dc}) + t \, (L_c * h_{d+1,c})

    By overlap-save, in windows that are transformed with the PSFs of the layers of their pixels.

    Args:
        plane: L, (B, C, H + P - 1, W + P - 1) light on a processor, float32 or float64.
        psfs: h, (D, C, P, P) with P odd, of the plane's dtype.
        layer_index: d, (B, H, W) int64.
        layer_weight: t, share of the next layer in [0, 1], (B, H, W) of the plane's dtype, or None for zero.
        size: side of a window in samples, see :func:`~kornia_tidy.kernels.window_sides.is_window_size`, at least P.
        correlate: with PSFs that are flipped by 180 degrees.
        weight_gradient: return :math:`\partial I_c / \partial t` instead.

    Returns:
        (B, C, H, W). It has gradients with respect to plane, psfs and layer_weight.

    Raises:
        TypeError: if a data type is not as above.
        ValueError: if shapes or the size do not fit.
        IndexError: if a pixel lies in no layer.
        MemoryError: if there is no memory for the spectra.
        NotBuiltError: if the source cannot be compiled.
    """
    return torch.ops.kornia_tidy.gather_overlap(
        plane, psfs, layer_index, layer_weight, size, correlate, weight_gradient
    )


def scatter_overlap(
    pixels: Tensor,
    psfs: Tensor,
    layer_index: Tensor,
    layer_weight: Tensor | None,
    size: int,
    *,
    correlate: bool = False,
    weight_gradient: bool = False,
) -> Tensor:
    """Spread the light of pixels by the PSFs of their layers: the transpose of :func:`gather_overlap`, by overlap-add.

    Args:
        pixels: I, (B, C, H, W) on a processor, float32 or float64.
        psfs: and the other arguments as there.
        layer_index: (B, H, W).
        layer_weight: (B, H, W), or None.
        size: side of a window in samples.
        correlate: with PSFs that are flipped. The gradient of :func:`gather_overlap` with respect to its plane takes
            the opposite of what that took.
        weight_gradient: as there.

    Returns:
        (B, C, H + P - 1, W + P - 1) light, added in the same order every time. It has gradients with respect to pixels,
        psfs and layer_weight. Errors are those of :func:`gather_overlap`.
    """
    return torch.ops.kornia_tidy.scatter_overlap(
        pixels, psfs, layer_index, layer_weight, size, correlate, weight_gradient
    )


def overlap_psf_gradient(
    plane: Tensor,
    pixels: Tensor,
    layer_index: Tensor,
    layer_weight: Tensor | None,
    layers: int,
    size: int,
    *,
    correlate: bool = False,
    weight_gradient: bool = False,
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
        weight_gradient: as there.

    Returns:
        (D, C, P, P), added in the same order every time with as many threads. It has gradients with respect to plane,
        pixels and layer_weight. Errors are those of :func:`gather_overlap`.
    """
    return torch.ops.kornia_tidy.overlap_psf_gradient(
        plane, pixels, layer_index, layer_weight, layers, size, correlate, weight_gradient
    )


class _Tiles(ctypes.Structure):
    """The struct ``tiles`` in overlap.c."""

    _fields_ = (
        *((name, ctypes.c_int64) for name in ("images", "channels", "height", "width", "layers", "side", "threads")),
        *((name, ctypes.c_int64) for name in ("rows", "columns", "origin", "correlate", "weight_gradient")),
        *((name, ctypes.c_int64) for name in ("plane_image", "plane_channel", "plane_row")),
        *((name, ctypes.c_int64) for name in ("pixels_image", "pixels_channel", "pixels_row")),
        *((name, ctypes.c_int64) for name in ("index_image", "index_row", "weight_image", "weight_row")),
        *((name, ctypes.c_void_p) for name in ("psfs", "index", "weight", "plane", "pixels", "out")),
    )


def _call(
    function: str,
    out: Tensor,
    side: int,
    layers: int,
    labels: tuple[Tensor, Tensor | None],
    size: int,
    correlate: bool,
    weight_gradient: bool,
    **tensors: Tensor,
) -> Tensor:
    """Call a function of overlap.c that writes to ``out``, and return it."""
    kept = {name: rows_in_memory(tensor) for name, tensor in tensors.items() if name != "psfs"}
    kept["index"] = rows_in_memory(labels[0])
    if labels[1] is not None:
        kept["weight"] = rows_in_memory(labels[1])
    images, height, width = labels[0].shape
    step = size_step(out.dtype)
    given = _Tiles(
        images=images,
        channels=out.shape[1],
        height=height,
        width=width,
        layers=layers,
        side=side,
        threads=torch.get_num_threads(),
        rows=needed_side(size, height, side, step // 2),
        columns=needed_side(size, width, side, step),
        origin=(side - 1) * (correlate == (function == "scatter")),
        correlate=correlate,
        weight_gradient=weight_gradient,
    )
    for name, tensor in kept.items():
        axes = ("image", "channel", "row") if tensor.ndim == 4 else ("image", "row")
        for axis, stride in zip(axes, tensor.stride(), strict=False):
            setattr(given, f"{name}_{axis}", stride)
    if "psfs" in tensors:
        kept["psfs"] = tensors["psfs"].contiguous()
    kept["out"] = out
    for name, tensor in kept.items():
        setattr(given, name, tensor.data_ptr())
    status = getattr(load(SOURCE, out.dtype), function)(ctypes.byref(given)) if images and out.numel() else 0
    if status == NO_LAYER:
        raise IndexError(f"a pixel lies in none of the {layers} layers: its depth or defocus is not a number")
    if status == NO_MEMORY:
        raise MemoryError(f"no memory for the spectra of {layers} PSFs in windows of {size}x{size} samples")
    return out


# ---------------------------------------------------------------------- checks, which are the fake implementations too


def _check(
    light: dict[str, Tensor],
    side: int,
    labels: tuple[Tensor, Tensor | None],
    size: int,
    weight_gradient: bool,
) -> None:
    """Check tensors by their names, the labels of their pixels and the side of a window."""
    shapes = []
    for name, tensor in light.items():
        if tensor.dtype not in REALS:
            raise TypeError(f"{name} must be float32 or float64, got {tensor.dtype}")
        if tensor.ndim != 4 or 0 in tensor.shape[1:]:
            raise ValueError(
                f"{name} must have four dimensions, only the first may be empty, got {tuple(tensor.shape)}"
            )
        lost = side - 1 if name == "plane" else 0
        shapes.append((name, tensor.dtype, (tensor.shape[0], tensor.shape[2] - lost, tensor.shape[3] - lost)))
    (name, dtype, shape), (other, other_dtype, other_shape) = shapes[0], shapes[-1]
    if dtype != other_dtype:
        raise TypeError(f"{other} must be of the {name}'s dtype {dtype}, got {other_dtype}")
    if shape != other_shape:
        raise ValueError(f"{name} and {other} must have the same pixels, got {shape} and {other_shape}")
    if side < 1 or side % 2 == 0:
        raise ValueError(f"PSFs must have an odd side of at least 1 pixel, got {side}")
    index, weight = labels
    if index.dtype != torch.int64:
        raise TypeError(f"layer_index must be int64, got {index.dtype}")
    if weight is not None and weight.dtype != dtype:
        raise TypeError(f"layer_weight must be of the light's dtype {dtype}, got {weight.dtype}")
    for label, tensor in (("layer_index", index), ("layer_weight", weight)):
        if tensor is not None and tuple(tensor.shape) != shape:
            raise ValueError(f"{label} must have the shape of the pixels {shape}, got {tuple(tensor.shape)}")
    if weight_gradient and weight is None:
        raise ValueError("weight_gradient needs a layer_weight, got None")
    if size < side or not is_window_size(size, dtype):
        raise ValueError(
            f"size must be at least the PSFs' side {side}, a multiple of {size_step(dtype)} and without prime factors "
            f"but 2, 3 and 5, got {size}"
        )


def _check_psfs(psfs: Tensor, light: Tensor) -> None:
    if psfs.dtype != light.dtype:
        raise TypeError(f"psfs must be of the light's dtype {light.dtype}, got {psfs.dtype}")
    if psfs.ndim != 4 or psfs.shape[1] != light.shape[1] or psfs.shape[2] != psfs.shape[3]:
        raise ValueError(f"psfs must have shape (D, {light.shape[1]}, P, P), got {tuple(psfs.shape)}")


def _new_pixels(
    plane: Tensor, psfs: Tensor, index: Tensor, weight: Tensor | None, size: int, correlate: bool, weight_gradient: bool
) -> Tensor:
    _check({"plane": plane}, psfs.shape[-1], (index, weight), size, weight_gradient)
    _check_psfs(psfs, plane)
    return plane.new_empty(plane.shape[0], plane.shape[1], *index.shape[1:])


def _new_plane(
    pixels: Tensor,
    psfs: Tensor,
    index: Tensor,
    weight: Tensor | None,
    size: int,
    correlate: bool,
    weight_gradient: bool,
) -> Tensor:
    _check({"pixels": pixels}, psfs.shape[-1], (index, weight), size, weight_gradient)
    _check_psfs(psfs, pixels)
    lost = psfs.shape[-1] - 1
    return pixels.new_zeros(*pixels.shape[:2], pixels.shape[2] + lost, pixels.shape[3] + lost)


def _new_psfs(
    plane: Tensor,
    pixels: Tensor,
    index: Tensor,
    weight: Tensor | None,
    layers: int,
    size: int,
    correlate: bool,
    weight_gradient: bool,
) -> Tensor:
    side = plane.shape[-1] - pixels.shape[-1] + 1
    _check({"plane": plane, "pixels": pixels}, side, (index, weight), size, weight_gradient)
    return plane.new_zeros(layers, plane.shape[1], side, side)


# ---------------------------------------------------------------------- on processors


def _gather(plane: Tensor, psfs: Tensor, *rest: Any) -> Tensor:
    index, weight, *options = rest
    out = _new_pixels(plane, psfs, *rest)
    return _call("gather", out, psfs.shape[-1], len(psfs), (index, weight), *options, plane=plane, psfs=psfs)


def _scatter(pixels: Tensor, psfs: Tensor, *rest: Any) -> Tensor:
    index, weight, *options = rest
    out = _new_plane(pixels, psfs, *rest)
    return _call("scatter", out, psfs.shape[-1], len(psfs), (index, weight), *options, pixels=pixels, psfs=psfs)


def _psf_gradient(plane: Tensor, pixels: Tensor, *rest: Any) -> Tensor:
    index, weight, layers, *options = rest
    out = _new_psfs(plane, pixels, *rest)
    return _call("correlate", out, out.shape[-1], layers, (index, weight), *options, plane=plane, pixels=pixels)


# ---------------------------------------------------------------------- derivatives


def _derivatives(
    terms: tuple[Tensor, Tensor, Tensor],
    labels: tuple[Tensor, Tensor | None],
    options: tuple[int, bool, bool],
    wanted: tuple[bool, bool, bool, bool],
) -> list[Tensor | None]:
    """Return the derivatives of the sum in the module's docstring to plane, pixels, PSFs and weight, where wanted.

    Args:
        terms: plane, pixels and PSFs.
        labels: layer index and layer weight.
        options: size, correlate and weight_gradient of :func:`gather_overlap`.
        wanted: of plane, pixels, PSFs and weight.
    """
    (plane, pixels, psfs), (size, correlate, weight_gradient), ops = terms, options, torch.ops.kornia_tidy
    found: list[Tensor | None] = [None] * 4
    if wanted[0]:
        found[0] = ops.scatter_overlap(pixels, psfs, *labels, size, not correlate, weight_gradient)
    if wanted[1]:
        found[1] = ops.gather_overlap(plane, psfs, *labels, *options)
    if wanted[2]:
        found[2] = ops.overlap_psf_gradient(plane, pixels, *labels, len(psfs), *options)
    if wanted[3] and not weight_gradient:
        found[3] = (ops.gather_overlap(plane, psfs, *labels, size, correlate, True) * pixels).sum(1)
    return found


def _keep(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    ctx.save_for_backward(*inputs[:4])
    ctx.options = inputs[-3:]


def _pixels_backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
    plane, psfs, *labels = ctx.saved_tensors
    wanted = ctx.needs_input_grad[0], False, ctx.needs_input_grad[1], ctx.needs_input_grad[3]
    of_plane, _, of_psfs, of_weight = _derivatives((plane, gradient, psfs), tuple(labels), ctx.options, wanted)
    return of_plane, of_psfs, None, of_weight, None, None, None


def _plane_backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
    pixels, psfs, *labels = ctx.saved_tensors
    size, correlate, weight_gradient = ctx.options
    wanted = False, *ctx.needs_input_grad[:2], ctx.needs_input_grad[3]
    options = size, not correlate, weight_gradient
    _, of_pixels, of_psfs, of_weight = _derivatives((gradient, pixels, psfs), tuple(labels), options, wanted)
    return of_pixels, of_psfs, None, of_weight, None, None, None


def _psfs_backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
    plane, pixels, *labels = ctx.saved_tensors
    wanted = *ctx.needs_input_grad[:2], False, ctx.needs_input_grad[3]
    of_plane, of_pixels, _, of_weight = _derivatives((plane, pixels, gradient), tuple(labels), ctx.options, wanted)
    return of_plane, of_pixels, None, of_weight, None, None, None, None


for _name, _function, _fake, _backward in (
    ("kornia_tidy::gather_overlap", _gather, _new_pixels, _pixels_backward),
    ("kornia_tidy::scatter_overlap", _scatter, _new_plane, _plane_backward),
    ("kornia_tidy::overlap_psf_gradient", _psf_gradient, _new_psfs, _psfs_backward),
):
    torch.library.impl(_name, "CPU", _function)
    torch.library.register_fake(_name, _fake)
    torch.library.register_autograd(_name, _backward, setup_context=_keep)
