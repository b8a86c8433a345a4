"""Occlusion by direct convolution with SIMD vectors, sample by sample.

A block of 8 x 16 pixels (in float32) meets the layers in its window, each only in the rows and columns where it is. All
that is added up is positive, so float32 is enough: the relative error of every sum is small, however small the
normaliser that it becomes. Whole weights along runs of pixels are not even convolved: their blur is known from where
runs begin and end. The work is done in C (``occlusion.c``), see :mod:`kornia_tidy.kernels.build`. Gradients are made by
tiles.
"""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from kornia_tidy.kernels.build import KERNELS, REALS, compiled
from kornia_tidy.render.backends.dense_occlusion import OcclusionPlanes
from kornia_tidy.render.backends.tile_plan import WINDOWS, choose_grid
from kornia_tidy.render.backends.tiled_occlusion import occlusion_gradients
from kornia_tidy.render.backends.window_plan import WindowPlan, plan_windows
from kornia_tidy.render.layers import Labels
from kornia_tidy.render.scene import LayeredScene

SOURCE = KERNELS / "occlusion.c"
BAND, STRIP_BYTES = 8, 64  # a block of pixels, see occlusion.c
SMALLEST_SIDE = BAND - 1  # px, of PSFs; smaller ones are made as large
NEGATIVE = 1e-4  # of a PSF: over EPSILON it makes a float32's round-off 1e-5
COUNTED = 12  # bands of blocks, of which costs are known


class _Scene(ctypes.Structure):
    """The struct ``panes`` in occlusion.c."""

    _fields_ = (
        *((name, ctypes.c_int64) for name in ("images", "channels", "height", "width", "layers", "side", "threads")),
        *((name, ctypes.c_int64) for name in ("plane_image", "plane_channel", "plane_row", "map_image", "map_row")),
        *((name, ctypes.c_void_p) for name in ("plane", "psfs", "lower", "share", "mean", "veil", "out")),
    )


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
    smallest = (BAND, 2 * STRIP_BYTES // psfs.element_size())
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
    counts = count(scene.plane, scene.psfs, index, weight)
    return direct_cost(*counts, max(scene.psf_size, SMALLEST_SIDE))


def occlude_scene(planes: OcclusionPlanes, labels: Labels) -> Tensor:
    """Render with occlusion, with gradients by tiles.

    Args:
        planes: of the scene.
        labels: the layers of the pixels of ``planes``.

    Returns:
        (B, C, H, W).
    """
    return _OccludeDirectly.apply(*planes, labels)


class _OccludeDirectly(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, *planes_and_labels: Any) -> Tensor:
        *tensors, ctx.labels = planes_and_labels
        planes = OcclusionPlanes(*tensors)
        ctx.save_for_backward(*planes)
        light, psfs, weight, mean, stray_light, index, inside = planes
        return occlude_directly(light, psfs, index, weight, mean, stray_light, inside)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        planes, labels = OcclusionPlanes(*ctx.saved_tensors), ctx.labels

        def plan() -> WindowPlan:
            layers, channels, psf_size = planes.psfs.shape[:3]
            grid = choose_grid(labels, layers, psf_size, WINDOWS)
            return plan_windows(labels, layers, channels, grid, WINDOWS, dark=planes.inside is not None)

        return *occlusion_gradients(planes, plan, grad_outputs[0], ctx.needs_input_grad), None


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


def count(plane: Tensor, psfs: Tensor, layer_index: Tensor, layer_weight: Tensor | None) -> list[int]:
    """Return what :func:`direct_cost` wants to know, from every few bands of blocks."""
    scene, kept = _scene(plane, psfs, layer_index, layer_weight, None)
    every = max(1, scene.images * scene.height // (BAND * COUNTED))
    counts = (ctypes.c_int64 * 4)()
    if _library(plane.dtype).count(ctypes.byref(scene), ctypes.c_int64(every), counts):
        raise MemoryError(f"no memory to render with PSFs of {scene.side}x{scene.side} pixels")
    del kept
    return [every * number for number in counts]


def occlude_directly(
    plane: Tensor,
    psfs: Tensor,
    layer_index: Tensor,
    layer_weight: Tensor | None,
    mean: Tensor | None,
    stray_light: Tensor | None,
    inside: Tensor | None,
) -> Tensor:
    """Render with occlusion. See :func:`kornia_tidy.render.backends.dense_occlusion.occlude_dense`, which it equals.

    Args:
        plane: (B, C, H + P - 1, W + P - 1) image, with all that lies beyond its border.
        psfs: (D, C, P, P) of the plane's dtype, not negative anywhere.
        layer_index: (B or 1, H + P - 1, W + P - 1) layer of each pixel, in any dtype, and
        layer_weight: weight of the next one, or None.
        mean: (B, C) mean light of each image, and
        stray_light: (D, C) fraction of it that each layer takes on; or None.
        inside: (1, H + P - 1, W + P - 1) 1 on the image and 0 in the dark beyond it, or None for no dark.

    Returns:
        (B, C, H, W).
    """
    scene, kept = _scene(plane, psfs, layer_index, layer_weight, inside)
    coded = plane.new_empty(*plane.shape[:2], scene.height, scene.width)
    scene.out = coded.data_ptr()
    if mean is not None and stray_light is not None:  # both or none
        kept += [mean.to(plane.dtype).contiguous(), stray_light.to(plane.dtype).contiguous()]
        scene.mean, scene.veil = (x.data_ptr() for x in kept[-2:])
    if _library(plane.dtype).occlude(ctypes.byref(scene)):
        raise MemoryError(f"no memory to render with PSFs of {scene.side}x{scene.side} pixels")
    del kept
    return coded


def _library(dtype: torch.dtype) -> ctypes.CDLL:
    library = compiled(SOURCE, dtype)
    assert library is not None
    return library


def _scene(
    plane: Tensor, psfs: Tensor, layer_index: Tensor, layer_weight: Tensor | None, inside: Tensor | None
) -> tuple[_Scene, list[Tensor]]:
    """Return what occlusion.c is told of a scene, and the tensors whose memory it names."""
    index, weight = layer_index.to(plane.dtype), layer_weight
    if weight is not None:  # what lies in one layer alone has the index of this layer
        full = weight == 1
        index, weight = index + full, weight.detach().to(plane.dtype).masked_fill(full, 0)
    if inside is not None:
        index = index.masked_fill(inside == 0, len(psfs))
    extra = (max(0, SMALLEST_SIDE - psfs.shape[-1]) // 2,) * 4
    if extra[0]:  # no light comes from there
        psfs, plane, index = pad(psfs, extra), pad(plane, extra), pad(index, extra, mode="replicate")
        weight = None if weight is None else pad(weight, extra, mode="replicate")
    plane, index, columns = (x.contiguous() for x in (plane, index, psfs.flip((-2, -1)).transpose(-2, -1)))
    scene = _Scene(
        images=plane.shape[0],
        channels=plane.shape[1],
        height=plane.shape[2] - psfs.shape[-1] + 1,
        width=plane.shape[3] - psfs.shape[-1] + 1,
        layers=psfs.shape[0],
        side=psfs.shape[-1],
        threads=torch.get_num_threads(),
        plane_image=plane.stride(0),
        plane_channel=plane.stride(1),
        plane_row=plane.stride(2),
        map_image=index.stride(0) if len(index) > 1 else 0,
        map_row=index.stride(1),
        plane=plane.data_ptr(),
        psfs=columns.data_ptr(),
        lower=index.data_ptr(),
    )
    if weight is None:
        return scene, [plane, index, columns]
    weight = weight.contiguous()
    scene.share = weight.data_ptr()
    return scene, [plane, index, columns, weight]
