"""Operators of gather by direct convolution: blurred light, and the gradient of the PSFs, in C.

Gather is linear in the light, in the PSFs and in the layer weights. The derivatives of the two operators are made of
the same two and of a transposed convolution, so they can be differentiated any number of times. The renderer replaces
the transposed convolution, which is slow, by tiles.

Operators are defined by schema, as ``torch.library.custom_op`` would import the compiler on the first call (3 s).
"""

from __future__ import annotations

import ctypes
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import conv_transpose2d

from kornia_tidy.kernels.build import KERNELS, load
from kornia_tidy.kernels.window_sides import size_step

SOURCE = KERNELS / "direct.c"
STRIP_ROWS = 4  # of a strip of pixels, see direct.c
SLABS = 4  # partial sums of a correlation for each thread: enough for all threads to end together
SLAB_BYTES = 64 << 20  # limit of the memory of all partial sums

torch.library.define(
    "kornia_tidy::gather_direct",
    "(Tensor plane, Tensor psfs, Tensor layer_index, Tensor? layer_weight, bool weight_gradient) -> Tensor",
)
torch.library.define(
    "kornia_tidy::gather_direct_psf_gradient",
    "(Tensor plane, Tensor gradient, Tensor layer_index, Tensor? layer_weight, SymInt layers, bool weight_gradient)"
    " -> Tensor",
)


def gather_direct(
    plane: Tensor,
    psfs: Tensor,
    layer_index: Tensor,
    layer_weight: Tensor | None = None,
    *,
    weight_gradient: bool = False,
) -> Tensor:
    r"""Convolve a plane with the PSFs of each pixel's layers and blend them: operator ``kornia_tidy::gather_direct``.

    .. math:: I_c = (1 - t) \, (L_c * h_{dc}) + t \, (L_c * h_{d+1,c})

    Args:
        plane: L, (B, C, H + P - 1, W + P - 1) light on a processor, float32 or float64.
        psfs: h, (D, C, P, P) with P odd, of the plane's dtype.
        layer_index: d, (B, H, W) int64.
        layer_weight: t, share of the next layer in [0, 1], (B, H, W) of the plane's dtype, or None for zero.
        weight_gradient: return :math:`\partial I_c / \partial t` instead.

    Returns:
        (B, C, H, W). It has gradients with respect to plane, psfs and layer_weight.

    Raises:
        TypeError: if a data type is not as above.
        ValueError: if shapes do not fit, or the output is smaller than a block of 4 x 32 (float64: 4 x 16) pixels.
        IndexError: if a pixel lies in no layer.
        NotBuiltError: if the source cannot be compiled.
    """
    return torch.ops.kornia_tidy.gather_direct(plane, psfs, layer_index, layer_weight, weight_gradient)


def gather_direct_psf_gradient(
    plane: Tensor,
    gradient: Tensor,
    layer_index: Tensor,
    layer_weight: Tensor | None,
    layers: int,
    *,
    weight_gradient: bool = False,
) -> Tensor:
    """Correlate a plane with the gradient of each layer's pixels: the gradient of gather with respect to the PSFs.

    Args:
        plane: (B, C, H + P - 1, W + P - 1) light, as for :func:`gather_direct`.
        gradient: (B, C, H, W) of what :func:`gather_direct` returns.
        layer_index: (B, H, W), as there.
        layer_weight: (B, H, W), as there, or None.
        layers: number of layers D.
        weight_gradient: as there.

    Returns:
        (D, C, P, P), summed in the same order every time. It has gradients with respect to plane, gradient and
        layer_weight.

    Raises:
        MemoryError: if there is no memory for the sums; otherwise as :func:`gather_direct`.
    """
    return torch.ops.kornia_tidy.gather_direct_psf_gradient(
        plane, gradient, layer_index, layer_weight, layers, weight_gradient
    )


def smallest_output(dtype: torch.dtype) -> tuple[int, int]:
    """Return the rows and columns of a block, below which an image is too small.

    Example:
        >>> smallest_output(torch.float32), smallest_output(torch.float64)
        ((4, 32), (4, 16))
    """
    return STRIP_ROWS, size_step(dtype)


class _Scene(ctypes.Structure):
    """The struct ``scene`` in direct.c."""

    _fields_ = (
        *((name, ctypes.c_int64) for name in ("images", "channels", "height", "width", "layers", "side", "threads")),
        *((name, ctypes.c_int64) for name in ("slabs", "plane_image", "plane_channel", "plane_row", "index_image")),
        *((name, ctypes.c_int64) for name in ("index_row", "weight_image", "weight_row", "weight_gradient")),
        *((name, ctypes.c_void_p) for name in ("plane", "psfs", "index", "weight", "gradient", "out")),
    )


def _scene(
    plane: Tensor, layer_index: Tensor, layer_weight: Tensor | None, layers: int, side: int
) -> tuple[_Scene, list[Tensor]]:
    """Return the scene for C, and the tensors whose memory it names."""
    plane, index = rows_in_memory(plane), rows_in_memory(layer_index)
    scene = _Scene(
        images=plane.shape[0],
        channels=plane.shape[1],
        height=index.shape[-2],
        width=index.shape[-1],
        layers=layers,
        side=side,
        threads=torch.get_num_threads(),
        plane_image=plane.stride(0),
        plane_channel=plane.stride(1),
        plane_row=plane.stride(2),
        index_image=index.stride(0),
        index_row=index.stride(1),
        plane=plane.data_ptr(),
        index=index.data_ptr(),
    )
    if layer_weight is None:
        return scene, [plane, index]
    weight = rows_in_memory(layer_weight)
    scene.weight_image, scene.weight_row, scene.weight = weight.stride(0), weight.stride(1), weight.data_ptr()
    return scene, [plane, index, weight]


def rows_in_memory(plane: Tensor) -> Tensor:
    """Return a plane with the pixels of each row side by side in memory."""
    return plane if plane.stride(-1) == 1 else plane.contiguous()


# ---------------------------------------------------------------------- light


def _check_plane(plane: Tensor) -> None:
    if plane.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"plane must be float32 or float64, got {plane.dtype}")
    if plane.ndim != 4 or 0 in plane.shape[1:]:
        raise ValueError(f"plane must have shape (B, C, H + P - 1, W + P - 1), got {tuple(plane.shape)}")


def _check_layers(
    plane: Tensor, layer_index: Tensor, layer_weight: Tensor | None, side: int, weight_gradient: bool
) -> None:
    if layer_index.dtype != torch.int64:
        raise TypeError(f"layer_index must be int64, got {layer_index.dtype}")
    if layer_weight is not None and layer_weight.dtype != plane.dtype:
        raise TypeError(f"layer_weight must be of the plane's dtype {plane.dtype}, got {layer_weight.dtype}")
    if side < 1 or side % 2 == 0:
        raise ValueError(f"PSFs must have an odd side of at least 1 pixel, got {side}")
    output = (plane.shape[0], plane.shape[-2] - side + 1, plane.shape[-1] - side + 1)
    smallest = smallest_output(plane.dtype)
    if output[1] < smallest[0] or output[2] < smallest[1]:
        raise ValueError(
            f"the output must have at least {smallest[0]}x{smallest[1]} pixels, got {output[1]}x{output[2]}"
        )
    for name, tensor in (("layer_index", layer_index), ("layer_weight", layer_weight)):
        if tensor is not None and tuple(tensor.shape) != output:
            raise ValueError(f"{name} must have the output's shape {output}, got {tuple(tensor.shape)}")
    if weight_gradient and layer_weight is None:
        raise ValueError("weight_gradient needs a layer_weight, got None")


def _new_light(
    plane: Tensor, psfs: Tensor, layer_index: Tensor, layer_weight: Tensor | None, weight_gradient: bool
) -> Tensor:
    """Check the arguments and return the memory of the result, which is also the fake implementation."""
    _check_plane(plane)
    if psfs.dtype != plane.dtype:
        raise TypeError(f"psfs must be of the plane's dtype {plane.dtype}, got {psfs.dtype}")
    if psfs.ndim != 4 or psfs.shape[1] != plane.shape[1] or psfs.shape[2] != psfs.shape[3]:
        raise ValueError(f"psfs must have shape (D, {plane.shape[1]}, P, P), got {tuple(psfs.shape)}")
    _check_layers(plane, layer_index, layer_weight, psfs.shape[-1], weight_gradient)
    return plane.new_empty(plane.shape[0], plane.shape[1], *layer_index.shape[1:])


def _gather(
    plane: Tensor, psfs: Tensor, layer_index: Tensor, layer_weight: Tensor | None, weight_gradient: bool
) -> Tensor:
    light = _new_light(plane, psfs, layer_index, layer_weight, weight_gradient)
    columns = psfs.flip((-2, -1)).transpose(-2, -1).contiguous()
    scene, kept = _scene(plane, layer_index, layer_weight, len(psfs), psfs.shape[-1])
    scene.psfs, scene.out, scene.weight_gradient = columns.data_ptr(), light.data_ptr(), weight_gradient
    if load(SOURCE, plane.dtype).mix(ctypes.byref(scene)):
        raise IndexError(f"a pixel lies in none of the {len(psfs)} layers: its depth or defocus is not a number")
    del kept
    return light


def _keep_light(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    ctx.save_for_backward(*inputs[:4])
    ctx.weight_gradient = inputs[4]


def _light_backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
    plane, psfs, layer_index, layer_weight = ctx.saved_tensors
    of_plane = of_psfs = of_weight = None
    if ctx.needs_input_grad[0]:
        of_plane = _transposed(gradient, psfs, layer_index, layer_weight, weight_gradient=ctx.weight_gradient)
    if ctx.needs_input_grad[1]:
        of_psfs = gather_direct_psf_gradient(
            plane, gradient, layer_index, layer_weight, len(psfs), weight_gradient=ctx.weight_gradient
        )
    if ctx.needs_input_grad[3] and not ctx.weight_gradient:
        of_weight = (gather_direct(plane, psfs, layer_index, layer_weight, weight_gradient=True) * gradient).sum(1)
    return of_plane, of_psfs, None, of_weight, None


# ---------------------------------------------------------------------- gradient of the PSFs


def _new_psfs(
    plane: Tensor,
    gradient: Tensor,
    layer_index: Tensor,
    layer_weight: Tensor | None,
    layers: int,
    weight_gradient: bool,
) -> Tensor:
    """Check the arguments and return the memory of the result, which is also the fake implementation."""
    _check_plane(plane)
    if gradient.dtype != plane.dtype:
        raise TypeError(f"gradient must be of the plane's dtype {plane.dtype}, got {gradient.dtype}")
    side = plane.shape[-1] - gradient.shape[-1] + 1
    _check_layers(plane, layer_index, layer_weight, side, weight_gradient)
    output = (plane.shape[0], plane.shape[1], *layer_index.shape[1:])
    if tuple(gradient.shape) != tuple(output):
        raise ValueError(f"gradient must have the output's shape {tuple(output)}, got {tuple(gradient.shape)}")
    return plane.new_empty(layers, plane.shape[1], side, side)


def _psf_gradient(
    plane: Tensor,
    gradient: Tensor,
    layer_index: Tensor,
    layer_weight: Tensor | None,
    layers: int,
    weight_gradient: bool,
) -> Tensor:
    psfs = _new_psfs(plane, gradient, layer_index, layer_weight, layers, weight_gradient)
    gradient = gradient.contiguous()
    slabs = max(1, min(SLABS * torch.get_num_threads(), SLAB_BYTES // max(psfs.nbytes, 1)))
    sums = psfs.new_zeros(slabs, *psfs.shape)
    scene, kept = _scene(plane, layer_index, layer_weight, layers, psfs.shape[-1])
    scene.gradient, scene.out, scene.slabs = gradient.data_ptr(), sums.data_ptr(), slabs
    scene.weight_gradient = weight_gradient
    if load(SOURCE, plane.dtype).correlate(ctypes.byref(scene)):
        raise MemoryError(f"no memory to correlate with PSFs of {psfs.shape[-1]}x{psfs.shape[-1]} pixels")
    del kept
    return sums.sum(0).flip((-2, -1))


def _keep_psfs(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    ctx.save_for_backward(*inputs[:4])
    ctx.weight_gradient = inputs[5]


def _psfs_backward(ctx: Any, of_psfs: Tensor) -> tuple[Tensor | None, ...]:
    plane, gradient, layer_index, layer_weight = ctx.saved_tensors
    of_psfs, labels = of_psfs.contiguous(), (layer_index, layer_weight)
    of_plane = of_gradient = of_weight = None
    if ctx.needs_input_grad[0]:
        of_plane = _transposed(gradient, of_psfs, *labels, weight_gradient=ctx.weight_gradient)
    if ctx.needs_input_grad[1]:
        of_gradient = gather_direct(plane, of_psfs, *labels, weight_gradient=ctx.weight_gradient)
    if ctx.needs_input_grad[3] and not ctx.weight_gradient:
        of_weight = (gather_direct(plane, of_psfs, *labels, weight_gradient=True) * gradient).sum(1)
    return of_plane, of_gradient, None, of_weight, None, None


def _transposed(
    gradient: Tensor, psfs: Tensor, layer_index: Tensor, layer_weight: Tensor | None, *, weight_gradient: bool
) -> Tensor:
    """Return the gradient of gather with respect to the plane: each layer's pixels spread by its PSF."""
    planes = []
    for layer, psf in enumerate(psfs):
        here, below = layer_index == layer, layer_index == layer - 1
        if weight_gradient:
            weight = below.to(psfs.dtype) - here.to(psfs.dtype)
        elif layer_weight is None:
            weight = here.to(psfs.dtype)
        else:
            weight = torch.where(here, 1 - layer_weight, torch.where(below, layer_weight, 0))
        kernel = psf.flip((-2, -1))[:, None]
        planes.append(conv_transpose2d(gradient * weight[:, None], kernel, groups=psfs.shape[1]))
    return torch.stack(planes).sum(0)


for _name, _function, _fake, _keep, _backward in (
    ("kornia_tidy::gather_direct", _gather, _new_light, _keep_light, _light_backward),
    ("kornia_tidy::gather_direct_psf_gradient", _psf_gradient, _new_psfs, _keep_psfs, _psfs_backward),
):
    torch.library.impl(_name, "CPU", _function)
    torch.library.register_fake(_name, _fake)
    torch.library.register_autograd(_name, _backward, setup_context=_keep)
