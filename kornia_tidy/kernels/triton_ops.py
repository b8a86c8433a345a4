"""Direct convolution on graphics processors: tensors in, launches of the kernels in Triton, tensors out.

Gather and scatter are each other's transpose, so three kernels make both of them and their gradients: gather takes the
PSFs of the pixel that light comes to, scatter those of the pixel that it comes from, and a correlation gives the
gradient of the PSFs. The operators of :mod:`kornia_tidy.kernels.gather_ops` and
:mod:`kornia_tidy.kernels.occlusion_ops` run these on CUDA devices.

Triton comes with PyTorch for CUDA; it is imported when a kernel is first wanted. Its interpreter
(``TRITON_INTERPRET=1``, the extra ``triton``) runs kernels on tensors of the CPU, slowly, for tests.
"""

from __future__ import annotations

import importlib.util
import math
import os
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

ROWS, COLUMNS = 8, 32  # of a tile of the output
LAYERS, PIXELS, MOST_TAPS = 16, 32, 64  # of a product of matrices in a correlation
SLAB_BYTES = 64 << 20  # limit of the memory of all partial sums of a correlation
ROWS_EACH = 32  # rows of images that one partial sum holds: more blocks for a processor, and a smaller rounding error


def objection(device: torch.device) -> str | None:
    """Return why kernels in Triton do not run on a device, as the end of a sentence, or None if they do.

    Example:
        >>> objection(torch.device("meta"))
        "Triton's kernels run on CUDA GPUs, and the tensors are on 'meta'"
    """
    interpreted = os.environ.get("TRITON_INTERPRET") == "1"
    if device.type != "cuda" and not (device.type == "cpu" and interpreted):
        return f"Triton's kernels run on CUDA GPUs, and the tensors are on {device.type!r}"
    if importlib.util.find_spec("triton") is None:
        return "Triton is not installed: it comes with PyTorch for CUDA on Linux, or as kornia-tidy[triton]"
    return None


def gather(
    light: Tensor,
    psfs: Tensor,
    layer_index: Tensor,
    layer_weight: Tensor | None = None,
    *,
    offset: int = 0,
    weight_gradient: bool = False,
) -> Tensor:
    r"""Convolve light with the PSFs of the layers of the pixels that it comes to, and blend them.

    .. math:: I_c(y, x) = \sum_{j, k} h_{d(y, x), c}(j, k) \, L_c(y + j - o, x + k - o)

    Args:
        light: L, (B, C, H', W') float32 or float64; it is zero beyond.
        psfs: h, (D, C, P, P) of the light's dtype, flipped by 180 degrees for a convolution.
        layer_index: d, (B or 1, H, W) int64; a pixel of no layer becomes NaN.
        layer_weight: share of the next layer, (B or 1, H, W) of the light's dtype, or None for zero.
        offset: o, rows and columns of zeros above and left of the light.
        weight_gradient: return the derivative with respect to ``layer_weight`` instead.

    Returns:
        (B, C, H, W).
    """
    out = light.new_empty(*light.shape[:2], *layer_index.shape[-2:])
    arguments = _tiled_arguments(light, psfs, layer_index, layer_weight, out, offset)
    linear = layer_weight is not None
    launch("gather_kernel", _tiles(out), *arguments, offset > 0, linear, weight_gradient, ROWS, COLUMNS)
    return out


def scatter(
    light: Tensor,
    psfs: Tensor,
    layer_index: Tensor,
    layer_weight: Tensor | None,
    size: tuple[int, int],
    *,
    offset: int = 0,
) -> Tensor:
    r"""Convolve light with the PSFs of the layers of the pixels that it comes from.

    .. math:: I_c(y, x) = \sum_{j, k} h_{d(y + j - o, x + k - o), c}(j, k) \, L_c(y + j - o, x + k - o)

    Args:
        light: as for :func:`gather`.
        psfs: as there.
        layer_index: d, (B or 1, H', W') int64; a pixel of no layer makes all NaN that it reaches.
        layer_weight: share of the next layer, of the same shape, or None.
        size: height H and width W of what is returned.
        offset: as there.

    Returns:
        (B, C, H, W).
    """
    out = light.new_empty(*light.shape[:2], *size)
    arguments = _tiled_arguments(light, psfs, layer_index, layer_weight, out, offset)
    launch("scatter_kernel", _tiles(out), *arguments, offset > 0, layer_weight is not None, ROWS, COLUMNS)
    return out


def correlate(
    light: Tensor,
    values: Tensor,
    layer_index: Tensor,
    layer_weight: Tensor | None,
    layers: int,
    side: int,
    *,
    offset: int = 0,
    weight_gradient: bool = False,
) -> Tensor:
    r"""Correlate light with the values of each layer's pixels: the gradient of gather or scatter to the PSFs.

    .. math:: g_{dc}(j, k) = \sum_{y, x} w_d(y, x) \, v_c(y, x) \, L_c(y + j - o, x + k - o)

    Args:
        light: L, as for :func:`gather`.
        values: v, (B, C, H, W) of the light's dtype.
        layer_index: (B or 1, H, W) int64; pixels of no layer have no weight.
        layer_weight: share of the next layer, of the same shape, or None.
        layers: number of layers D.
        side: P of the PSFs.
        offset: as there.
        weight_gradient: take the derivatives of the weights w instead of them.

    Returns:
        (D, C, P, P), summed in the same order every time.
    """
    light, values = _rows_in_memory(light), _rows_in_memory(values)
    index, weight = _labels(layer_index, layer_weight, layers, light)
    (images, channels), (height, width) = light.shape[:2], values.shape[-2:]
    slab = layers * channels * side * side
    rows = images * height
    parts = max(1, min(-(-rows // ROWS_EACH), SLAB_BYTES // (slab * light.element_size())))
    out = (
        light.new_zeros(1, layers, channels, side, side)
        if not rows
        else light.new_empty(parts, layers, channels, side, side)
    )
    taps = min(MOST_TAPS, max(16, _power_of_two(side)))
    if rows:
        programs = parts * channels * -(-layers // LAYERS) * side * -(-side // taps)
        launch(
            "correlate_kernel",
            programs,
            *(light, values, index, weight, out, images, height, width, *light.shape[-2:], channels),
            *(layers, offset, side, parts, -(-rows // parts), *light.stride()[:3], *values.stride()[:3]),
            *(*_map_strides(index), *_map_strides(weight), layer_weight is not None, weight_gradient),
            *(LAYERS, taps, PIXELS),
        )
    return out.sum(0)


def occlude(
    light: Tensor,
    psfs: Tensor,
    layer_index: Tensor,
    layer_weight: Tensor | None,
    mean: Tensor | None,
    stray_light: Tensor | None,
    inside: Tensor | None,
    epsilon: float,
) -> Tensor:
    """Render layers that hide one another, see :func:`kornia_tidy.kernels.occlusion_ops.occlusion_direct`.

    Args:
        light: (B, C, H + P - 1, W + P - 1) image with all that lies beyond its border.
        psfs: (D, C, P, P), flipped by 180 degrees for a convolution; not negative anywhere.
        layer_index: (B or 1, H + P - 1, W + P - 1) layer of each pixel, whole numbers of any dtype.
        layer_weight: share of the next layer, of the same shape, or None.
        mean: (B, C) mean light of each image, and
        stray_light: (D, C) share of it that each layer takes on; both or none.
        inside: (1, H + P - 1, W + P - 1) 1 on the image and 0 in the dark beyond it, or None for no dark.
        epsilon: added to the divisor.

    Returns:
        (B, C, H, W).
    """
    layers, side = len(psfs), psfs.shape[-1]
    if inside is not None:
        layer_index = layer_index.masked_fill(inside == 0, layers)
    light = _rows_in_memory(light)
    index, weight = _labels(layer_index, layer_weight, layers, light)
    out = light.new_empty(*light.shape[:2], light.shape[-2] - side + 1, light.shape[-1] - side + 1)
    stray = stray_light is not None and mean is not None  # both or none
    launch(
        "occlusion_kernel",
        _tiles(out),
        *(
            light,
            _taps(psfs),
            index,
            weight,
            *((mean.contiguous(), stray_light.contiguous()) if stray else (light,) * 2),
        ),
        *(out, *out.shape[-2:], light.shape[1], layers, side, *light.stride()[:3], *_map_strides(index)),
        *(*_map_strides(weight), epsilon, layer_weight is not None, stray, ROWS, COLUMNS, COLUMNS),
    )
    return out


def _tiled_arguments(
    light: Tensor, psfs: Tensor, layer_index: Tensor, layer_weight: Tensor | None, out: Tensor, offset: int
) -> tuple[Any, ...]:
    light = _rows_in_memory(light)
    layers, side = len(psfs), psfs.shape[-1]
    index, weight = _labels(layer_index, layer_weight, layers, light)
    sizes = *out.shape[-2:], *light.shape[-2:], light.shape[1], layers, offset, side
    strides = *light.stride()[:3], *_map_strides(index), *_map_strides(weight)
    return light, _taps(psfs), index, weight, out, *sizes, *strides


def _labels(layer_index: Tensor, layer_weight: Tensor | None, layers: int, light: Tensor) -> tuple[Tensor, Tensor]:
    """Return indices in int32, and weights. Without weights a view of the light is passed, which no kernel reads."""
    index = _once(layer_index).clamp(-1, layers).to(torch.int32)
    weight = light[:, 0] if layer_weight is None else _once(layer_weight)
    return _rows_in_memory(index), _rows_in_memory(weight)


def _once(maps: Tensor) -> Tensor:
    """Return maps (B, H, W), or the one (1, H, W) that all images share."""
    return maps[:1] if maps.stride(0) == 0 else maps


def _map_strides(maps: Tensor) -> tuple[int, int]:
    return (maps.stride(0) if len(maps) > 1 else 0), maps.stride(1)


def _taps(psfs: Tensor) -> Tensor:
    """Return the samples (C, P, P, D): a tap of all layers side by side."""
    return psfs.detach().permute(1, 2, 3, 0).contiguous()


def _rows_in_memory(plane: Tensor) -> Tensor:
    plane = plane.detach().resolve_neg()
    return plane if plane.stride(-1) == 1 else plane.contiguous()


def _tiles(out: Tensor) -> int:
    return math.prod(out.shape[:2]) * -(-out.shape[-2] // ROWS) * -(-out.shape[-1] // COLUMNS)


def _power_of_two(size: int) -> int:
    return 1 << (size - 1).bit_length()


def launch(name: str, programs: int, *arguments: Any) -> None:
    """Launch a kernel of :mod:`kornia_tidy.kernels.triton_kernels`, unless there is nothing to do.

    Args:
        name: of the kernel.
        programs: number of its programs.
        arguments: of the kernel; the first one is a tensor on its device.
    """
    if programs == 0:
        return
    kernel = getattr(_kernels(), name)
    device = arguments[0].device
    if device.type == "cuda":
        with torch.cuda.device(device):
            kernel[(programs,)](*arguments)
    else:
        kernel[(programs,)](*arguments)


def _kernels() -> ModuleType:
    from kornia_tidy.kernels import triton_kernels  # noqa: PLC0415

    return triton_kernels
