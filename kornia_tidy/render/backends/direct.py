"""The direct backend: convolution with SIMD vectors, sample by sample, on processors.

A block of 4 x 32 pixels (in float32) is convolved with the PSFs of its own layers and with no other: P x P products a
pixel for each. For PSFs of up to some 40 pixels that is faster than transforms, whose tiles are larger and hold more
layers. The work is done in C (``direct.c``), compiled on the machine that it runs on, see
:mod:`kornia_tidy.kernels.build`. The gradient with respect to the image is made by tiles: a pixel's light goes to
pixels of many layers.
"""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from torch import Tensor

from kornia_tidy.kernels.build import KERNELS, REALS, compiled
from kornia_tidy.render.backends import direct_occlusion
from kornia_tidy.render.backends.allocator import keep_memory
from kornia_tidy.render.backends.block_plan import plan_blocks
from kornia_tidy.render.backends.dense import gather_dense
from kornia_tidy.render.backends.dense_occlusion import occlusion_planes
from kornia_tidy.render.backends.tile_plan import BLOCKS, SHARED, choose_grid
from kornia_tidy.render.backends.tiled import gather_gradients, twice_differentiable
from kornia_tidy.render.layers import Labels
from kornia_tidy.render.scene import LayeredScene

SOURCE = KERNELS / "direct.c"
STRIP_ROWS, STRIP_BYTES = 4, 64  # a strip of pixels, see direct.c
EVERY = 4  # columns of strips are counted in every fourth row of them
SLABS = 4  # sums of a correlation that each thread makes in turn: enough for all to end together
SLAB_BYTES = 64 << 20  # and what all of them may take


class _Scene(ctypes.Structure):
    """The struct of the same name in direct.c."""

    _fields_ = (
        *((name, ctypes.c_int64) for name in ("images", "channels", "height", "width", "layers", "side", "threads")),
        *((name, ctypes.c_int64) for name in ("slabs", "plane_image", "plane_channel", "plane_row", "lower_image")),
        *((name, ctypes.c_int64) for name in ("lower_row", "share_image", "share_row", "slope")),
        *((name, ctypes.c_void_p) for name in ("plane", "psfs", "lower", "share", "own", "out")),
    )


class DirectBackend:
    """Convolution with SIMD vectors. See :class:`kornia_tidy.render.backend.Backend`."""

    name = "direct"

    def refusal(self, scene: LayeredScene) -> str | None:
        """Return why a scene cannot be convolved directly, or None if it can."""
        if scene.compositing == "scatter":
            return "direct convolution gathers light and does not scatter it"
        if scene.compositing == "occlusion":
            return direct_occlusion.refusal(scene.output_size, scene.psfs)
        return refusal(scene.output_size, scene.image)

    def seconds(self, scene: LayeredScene) -> float:
        """Return the estimated time, from the pairs of strips and layers; all of it is shared by threads."""
        if scene.compositing == "occlusion":
            cost = direct_occlusion.scene_cost(scene)
        else:
            cost = direct_cost(count_pairs(scene.labels, scene.image.dtype), scene.psf_size)
        return cost * scene.image.shape[1] / torch.get_num_threads() * 1e-9

    def least_seconds(self, scene: LayeredScene) -> float:
        """Return zero: to count is cheap."""
        del scene
        return 0.0

    def render(self, scene: LayeredScene) -> Tensor:
        """Return the rendered light."""
        keep_memory()
        if scene.compositing == "occlusion":
            return direct_occlusion.occlude_scene(occlusion_planes(scene), scene.labels)
        weight = scene.sorted_layers[1]
        weight = None if weight is None else weight.expand(len(scene.image), -1, -1)
        return _GatherDirectly.apply(scene.plane, scene.psfs, weight, scene.labels)


def refusal(output_size: tuple[int, int], image: Tensor) -> str | None:
    """Return why an output of a size cannot be gathered directly, or None if it can.

    Args:
        output_size: height and width.
        image: light, of which device and type count.
    """
    device, dtype = image.device.type, image.dtype
    if device != "cpu":
        return f"direct convolution runs on processors, and the image is on {device!r}"
    if dtype not in REALS:
        return f"direct convolution is in float32 or float64, and the image in {dtype}"
    smallest = (STRIP_ROWS, 2 * STRIP_BYTES // dtype.itemsize)
    if output_size[0] < smallest[0] or output_size[1] < smallest[1]:
        size = "x".join(map(str, output_size))
        return f"direct convolution needs an output of at least {smallest[0]}x{smallest[1]} pixels, got {size}"
    if compiled(SOURCE, dtype) is None:
        return "direct convolution needs a C compiler (see `kornia-tidy info`)"
    return None


def can_go_directly(labels: Labels, dtype: torch.dtype) -> bool:
    """Return whether labels of the output's pixels can be gathered directly, see :func:`refusal`."""
    height, width = labels.layer_index.shape[-2:]
    return refusal((height, width), torch.empty((), dtype=dtype, device=labels.layer_index.device)) is None


def is_direct_faster(direct: float, transforms: float) -> bool:
    """Return whether direct work is faster than transforms: threads share all of the one, ``SHARED`` of the other."""
    threads = torch.get_num_threads()
    return direct / threads < transforms * (1 - SHARED + SHARED / threads)


def direct_cost(pairs: int, side: int) -> float:
    r"""Return the time that direct convolution takes in nanoseconds a channel, on the core of ``tile_cost``.

    .. math:: N (70 + 0.95 P^2)

    for N pairs of a strip of 64 bytes by 4 rows and a layer present in it, and PSFs of P x P pixels.

    Example:
        >>> f"{direct_cost(29_650, 23) * 3e-6:.0f} ms"
        '51 ms'
    """
    return pairs * (70 + 0.95 * side**2)


class _GatherDirectly(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, plane: Tensor, psfs: Tensor, layer_weight: Tensor | None, labels: Labels) -> Tensor:
        ctx.save_for_backward(plane, psfs, layer_weight)
        ctx.labels = labels
        return mix_directly(plane, psfs, labels)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        (grad,), wanted, labels = grad_outputs, ctx.needs_input_grad, ctx.labels
        if torch.is_grad_enabled():
            return *twice_differentiable(gather_dense, ctx.saved_tensors, labels, grad, wanted), None
        plane, psfs, _ = ctx.saved_tensors
        of_plane = of_psfs = of_weight = None
        if wanted[0]:
            grid = choose_grid(labels, len(psfs), psfs.shape[-1])
            plan = plan_blocks(labels, len(psfs), grid, BLOCKS)
            of_plane, _, _ = gather_gradients(plane, psfs, grad, plan, (True, False, False))
        if wanted[1]:
            of_psfs = correlate_directly(plane, grad, labels, psfs.shape)
        if wanted[2]:
            of_weight = mix_directly(plane, psfs, labels, weight_gradient=True).mul_(grad).sum(1)
        return of_plane, of_psfs, of_weight, None


def mix_directly(plane: Tensor, psfs: Tensor, labels: Labels, *, weight_gradient: bool = False) -> Tensor:
    """Convolve a plane with the PSFs of each pixel's own layers and blend them: gather.

    Args:
        plane: (B, C, H + P - 1, W + P - 1) light.
        psfs: (D, C, P, P) of the plane's dtype.
        labels: the layers of each pixel, (B, H, W).
        weight_gradient: instead, what a pixel would gain by moving from its layer to the next.

    Returns:
        (B, C, H, W).

    Raises:
        IndexError: if a pixel lies in no layer.
    """
    batch, channels = plane.shape[:2]
    plane = _rows(plane)
    columns = psfs.flip((-2, -1)).transpose(-2, -1).contiguous()
    blended = plane.new_empty(batch, channels, *labels.layer_index.shape[-2:])
    scene, kept = _scene(plane, psfs.shape, labels)
    scene.psfs, scene.out, scene.slope = columns.data_ptr(), blended.data_ptr(), weight_gradient
    if _library(plane.dtype).mix(ctypes.byref(scene)):
        raise IndexError(f"a pixel lies in none of the {len(psfs)} layers: its depth or defocus is not a number")
    del kept
    return blended


def correlate_directly(plane: Tensor, own: Tensor, labels: Labels, shape: torch.Size) -> Tensor:
    """Return the gradient of the PSFs: the correlation of each layer's own pixels with the light that they see.

    Args:
        plane: (B, C, H + P - 1, W + P - 1) light.
        own: (B, C, H, W): for :func:`mix_directly` the gradient of what it returns.
        labels: the layers of each pixel of ``own``, (B, H, W).
        shape: (D, C, P, P) of the PSFs.

    Returns:
        (D, C, P, P). Sums are made in the same order every time.
    """
    plane, own = _rows(plane), own.contiguous()
    slabs = max(1, min(SLABS * torch.get_num_threads(), SLAB_BYTES // (shape.numel() * plane.element_size())))
    sums = plane.new_zeros(slabs, *shape)
    scene, kept = _scene(plane, shape, labels)
    scene.own, scene.out, scene.slabs = own.data_ptr(), sums.data_ptr(), slabs
    if _library(plane.dtype).correlate(ctypes.byref(scene)):
        raise MemoryError(f"no memory to correlate with PSFs of {shape[-1]}x{shape[-1]} pixels")
    del kept
    return sums.sum(0).flip((-2, -1))


def count_pairs(labels: Labels, dtype: torch.dtype) -> int:
    """Return how many pairs of a strip and a layer present in it there are, from every fourth row of strips."""
    plane = torch.empty((), dtype=dtype).expand(len(labels.layer_index), 1, 1, 1)
    scene, kept = _scene(plane, torch.Size((2**31 - 1, 1, 1, 1)), labels)  # however many layers there are
    pairs = _library(dtype).count_pairs(ctypes.byref(scene), EVERY)
    del kept
    return EVERY * pairs


def _library(dtype: torch.dtype) -> ctypes.CDLL:
    library = compiled(SOURCE, dtype)
    assert library is not None
    library.count_pairs.restype = ctypes.c_int64
    library.count_pairs.argtypes = ctypes.c_void_p, ctypes.c_int64
    return library


def _rows(plane: Tensor) -> Tensor:
    """Return a plane whose rows lie in one piece."""
    return plane if plane.stride(-1) == 1 else plane.contiguous()


def _scene(plane: Tensor, shape: torch.Size, labels: Labels) -> tuple[_Scene, list[Tensor]]:
    """Return what direct.c is told, and the tensors whose memory it names."""
    index = _rows(labels.layer_index)
    weight = None if labels.layer_weight is None else _rows(labels.layer_weight.to(plane.dtype))
    scene = _Scene(
        images=plane.shape[0],
        channels=plane.shape[1],
        height=index.shape[-2],
        width=index.shape[-1],
        layers=shape[0],
        side=shape[-1],
        threads=torch.get_num_threads(),
        plane_image=plane.stride(0),
        plane_channel=plane.stride(1),
        plane_row=plane.stride(2),
        lower_image=index.stride(0),
        lower_row=index.stride(1),
        plane=plane.data_ptr(),
        lower=index.data_ptr(),
    )
    if weight is not None:
        scene.share_image, scene.share_row, scene.share = weight.stride(0), weight.stride(1), weight.data_ptr()
    return scene, [plane, index] if weight is None else [plane, index, weight]
