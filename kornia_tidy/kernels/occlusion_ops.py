"""Operator of occlusion by direct convolution: in C.

Sums are of positive terms only, so float32 keeps their relative accuracy however small the divisor that they become.
A second operator makes the gradients of PSFs and stray light. Those of light and layers the renderer makes by tiles.

The operator is defined by schema, as ``torch.library.custom_op`` would import the compiler on the first call (3 s).
"""

from __future__ import annotations

import ctypes
from typing import Any, NoReturn

import torch
from torch import Tensor
from torch.nn.functional import pad

from kornia_tidy.kernels.build import KERNELS, load, vector_bytes
from kornia_tidy.kernels.window_sides import size_step

SOURCE = KERNELS / "occlusion.c"
BLOCK_ROWS = 8  # of a block of pixels, see occlusion.c
EPSILON = 1e-6  # added to the divisor, see occlusion.c
SMALLEST_SIDE = BLOCK_ROWS - 1  # px, of PSFs; smaller ones are padded to it
# Operations for each pixel of a block, as many as take as long: to begin and end the sums of a layer, for a column of a
# PSF that meets a row of light, and for an end of a run of whole weights.
_BLOCK, _COLUMN, _END = 170, 1, 3

_SCENE = (
    "Tensor plane, Tensor psfs, Tensor layer_index, Tensor? layer_weight, Tensor? mean, Tensor? stray_light,"
    " Tensor? inside"
)
torch.library.define("kornia_tidy::occlusion_direct", f"({_SCENE}) -> Tensor")
torch.library.define("kornia_tidy::occlusion_direct_gradients", f"({_SCENE}, Tensor gradient) -> Tensor[]")


def occlusion_direct(
    plane: Tensor,
    psfs: Tensor,
    layer_index: Tensor,
    layer_weight: Tensor | None = None,
    mean: Tensor | None = None,
    stray_light: Tensor | None = None,
    inside: Tensor | None = None,
) -> Tensor:
    """Render layers that hide one another by direct convolution: operator ``kornia_tidy::occlusion_direct``.

    Args:
        plane: (B, C, H + P - 1, W + P - 1) image on a processor, with all that lies beyond its border; float32
            or float64.
        psfs: (D, C, P, P) with P odd, of the plane's dtype, not negative anywhere. Layer D - 1 is the nearest.
        layer_index: (B or 1, H + P - 1, W + P - 1) layer of each pixel, whole numbers of any dtype.
        layer_weight: share of the next layer in [0, 1], of the same shape and the plane's dtype, or None for zero.
        mean: (B, C) mean light of each image, and
        stray_light: (D, C) share of it that each layer takes on; both or none.
        inside: (1, H + P - 1, W + P - 1) 1 on the image and 0 in the dark beyond it, or None for no dark.

    Returns:
        (B, C, H, W). It has no gradient.

    Raises:
        TypeError: if a data type is not as above.
        ValueError: if shapes do not fit, or the output is smaller than a block of 8 x 32 (float64: 8 x 16) pixels; GPUs
            take any size.
        MemoryError: if there is no memory for the tables.
        NotBuiltError: if the source cannot be compiled.
    """
    return torch.ops.kornia_tidy.occlusion_direct(plane, psfs, layer_index, layer_weight, mean, stray_light, inside)


def occlusion_direct_gradients(
    plane: Tensor,
    psfs: Tensor,
    layer_index: Tensor,
    layer_weight: Tensor | None,
    mean: Tensor | None,
    stray_light: Tensor | None,
    inside: Tensor | None,
    gradient: Tensor,
) -> list[Tensor]:
    """Return gradients of :func:`occlusion_direct`: operator ``kornia_tidy::occlusion_direct_gradients``.

    Each block is rendered again, and its convolutions and compositing are transposed.

    Args:
        plane: as there, as the arguments up to ``inside``, but on a processor.
        psfs: as there.
        layer_index: as there.
        layer_weight: as there.
        mean: as there.
        stray_light: as there.
        inside: as there.
        gradient: (B, C, H, W) of the light, of the plane's dtype.

    Returns:
        The gradient of the PSFs and, where there is stray light, that of ``stray_light``. They have none.

    Raises:
        TypeError: as there.
        ValueError: as there, or if the gradient does not fit.
        MemoryError: as there.
        NotBuiltError: as there.
    """
    return torch.ops.kornia_tidy.occlusion_direct_gradients(
        plane, psfs, layer_index, layer_weight, mean, stray_light, inside, gradient
    )


def count_operations(
    layer_index: Tensor, layer_weight: Tensor | None, psfs: Tensor, batch: int, bands: int = 12
) -> float:
    """Count the operations of :func:`occlusion_direct` for one channel, in some bands of blocks, scaled to the image.

    Args:
        layer_index: as there.
        layer_weight: as there.
        psfs: as there. Their values do not matter.
        batch: images.
        bands: that are counted.

    Example:
        >>> flat, psfs = torch.zeros(1, 72, 128), torch.zeros(3, 1, 9, 9)
        >>> 2 < count_operations(flat, None, psfs, batch=1) / (64 * 120 * 9**2) < 6  # products and sums
        True
    """
    plane = psfs.new_empty(()).expand(batch, 1, *layer_index.shape[1:])
    scene, kept = _scene(plane, psfs[:, :1], layer_index, layer_weight, None)
    every = max(1, scene.images * scene.height // (BLOCK_ROWS * bands))
    counts, library = (ctypes.c_int64 * 4)(), load(SOURCE, psfs.dtype)
    if library.count(ctypes.byref(scene), ctypes.c_int64(every), counts):
        raise MemoryError(f"no memory to render with PSFs of {scene.side}x{scene.side} pixels")
    del kept
    alone, pairs, columns, ends = counts  # blocks of one layer, pairs of another block and a layer, ...
    of_pixel = alone * (2 * scene.side**2 + _BLOCK) + pairs * _BLOCK + columns * _COLUMN + ends * _END
    return float(every * BLOCK_ROWS * vector_bytes(library) // psfs.itemsize * of_pixel)


def smallest_output(dtype: torch.dtype) -> tuple[int, int]:
    """Return the rows and columns of a block, below which an image is too small.

    Example:
        >>> smallest_output(torch.float32), smallest_output(torch.float64)
        ((8, 32), (8, 16))
    """
    return BLOCK_ROWS, size_step(dtype)


class _Scene(ctypes.Structure):
    """The struct ``scene_parameters`` in occlusion.c."""

    _fields_ = (
        *((name, ctypes.c_int64) for name in ("images", "channels", "height", "width", "layers", "side", "threads")),
        *((name, ctypes.c_int64) for name in ("plane_image", "plane_channel", "plane_row", "map_image", "map_row")),
        *((name, ctypes.c_void_p) for name in ("plane", "psfs", "index", "weight", "mean", "stray_light", "out")),
        *((name, ctypes.c_void_p) for name in ("gradient", "psf_gradient", "stray_light_gradient")),
    )


def _scene(
    plane: Tensor, psfs: Tensor, layer_index: Tensor, layer_weight: Tensor | None, inside: Tensor | None
) -> tuple[_Scene, list[Tensor]]:
    """Return the scene for C, and the tensors whose memory it names."""
    index, weight = layer_index.to(plane.dtype), layer_weight
    if weight is not None:  # a pixel with a weight of one lies in the next layer alone
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
        index=index.data_ptr(),
    )
    if weight is None:
        return scene, [plane, index, columns]
    weight = weight.contiguous()
    scene.weight = weight.data_ptr()
    return scene, [plane, index, columns, weight]


def _new_light(
    plane: Tensor,
    psfs: Tensor,
    layer_index: Tensor,
    layer_weight: Tensor | None,
    mean: Tensor | None,
    stray_light: Tensor | None,
    inside: Tensor | None,
) -> Tensor:
    """Check the arguments and return the memory of the result, which is also the fake implementation."""
    if plane.dtype not in (torch.float32, torch.float64):
        raise TypeError(f"plane must be float32 or float64, got {plane.dtype}")
    for name, tensor in (("psfs", psfs), ("layer_weight", layer_weight), ("mean", mean), ("stray_light", stray_light)):
        if tensor is not None and tensor.dtype != plane.dtype:
            raise TypeError(f"{name} must be of the plane's dtype {plane.dtype}, got {tensor.dtype}")
    if plane.ndim != 4 or 0 in plane.shape[1:]:
        raise ValueError(f"plane must have shape (B, C, H + P - 1, W + P - 1), got {tuple(plane.shape)}")
    batch, channels, rows, columns = plane.shape
    if psfs.ndim != 4 or psfs.shape[1] != channels or psfs.shape[2] != psfs.shape[3] or psfs.shape[3] % 2 == 0:
        raise ValueError(f"psfs must have shape (D, {channels}, P, P) with P odd, got {tuple(psfs.shape)}")
    height, width = rows - psfs.shape[-1] + 1, columns - psfs.shape[-1] + 1
    smallest = smallest_output(plane.dtype)
    if height < smallest[0] or width < smallest[1]:
        raise ValueError(f"the output must have at least {smallest[0]}x{smallest[1]} pixels, got {height}x{width}")
    if tuple(layer_index.shape) not in ((batch, rows, columns), (1, rows, columns)):
        raise ValueError(
            f"layer_index must have shape {(batch, rows, columns)} or {(1, rows, columns)}, "
            f"got {tuple(layer_index.shape)}"
        )
    if (mean is None) != (stray_light is None):
        raise ValueError(f"stray_light needs a mean and a mean needs stray_light, got only {_one_of(mean)}")
    for name, tensor, shape in (
        ("layer_weight", layer_weight, tuple(layer_index.shape)),
        ("mean", mean, (batch, channels)),
        ("stray_light", stray_light, (psfs.shape[0], channels)),
        ("inside", inside, (1, rows, columns)),
    ):
        if tensor is not None and tuple(tensor.shape) != shape:
            raise ValueError(f"{name} must have shape {shape}, got {tuple(tensor.shape)}")
    return plane.new_empty(batch, channels, height, width)


def _one_of(mean: Tensor | None) -> str:
    return "stray_light" if mean is None else "mean"


def _occlude(
    plane: Tensor,
    psfs: Tensor,
    layer_index: Tensor,
    layer_weight: Tensor | None,
    mean: Tensor | None,
    stray_light: Tensor | None,
    inside: Tensor | None,
) -> Tensor:
    light = _new_light(plane, psfs, layer_index, layer_weight, mean, stray_light, inside)
    scene, kept = _scene(plane, psfs, layer_index, layer_weight, inside)
    scene.out = light.data_ptr()
    if mean is not None and stray_light is not None:  # both or none
        kept += [mean.contiguous(), stray_light.contiguous()]
        scene.mean, scene.stray_light = (x.data_ptr() for x in kept[-2:])
    if load(SOURCE, plane.dtype).occlude(ctypes.byref(scene)):
        raise MemoryError(f"no memory to render with PSFs of {scene.side}x{scene.side} pixels")
    del kept
    return light


def _new_gradients(
    plane: Tensor,
    psfs: Tensor,
    layer_index: Tensor,
    layer_weight: Tensor | None,
    mean: Tensor | None,
    stray_light: Tensor | None,
    inside: Tensor | None,
    gradient: Tensor,
) -> list[Tensor]:
    light = _new_light(plane, psfs, layer_index, layer_weight, mean, stray_light, inside)
    if gradient.shape != light.shape or gradient.dtype != light.dtype:
        raise ValueError(
            f"gradient must be {light.dtype} of shape {tuple(light.shape)}, got {gradient.dtype} of shape "
            f"{tuple(gradient.shape)}"
        )
    return [x.new_empty(x.shape) for x in (psfs, stray_light) if x is not None]


def _gradients(
    plane: Tensor,
    psfs: Tensor,
    layer_index: Tensor,
    layer_weight: Tensor | None,
    mean: Tensor | None,
    stray_light: Tensor | None,
    inside: Tensor | None,
    gradient: Tensor,
) -> list[Tensor]:
    found = _new_gradients(plane, psfs, layer_index, layer_weight, mean, stray_light, inside, gradient)
    scene, kept = _scene(plane, psfs, layer_index, layer_weight, inside)
    columns = psfs.new_empty(*psfs.shape[:2], scene.side, scene.side)
    kept += [gradient.contiguous(), columns]
    scene.gradient, scene.psf_gradient = (x.data_ptr() for x in kept[-2:])
    if mean is not None and stray_light is not None:  # both or none
        kept += [mean.contiguous(), stray_light.contiguous()]
        scene.mean, scene.stray_light = (x.data_ptr() for x in kept[-2:])
        scene.stray_light_gradient = found[1].data_ptr()
    if load(SOURCE, plane.dtype).occlusion_gradients(ctypes.byref(scene)):
        raise MemoryError(f"no memory for gradients of PSFs of {scene.side}x{scene.side} pixels")
    extra, side = (scene.side - psfs.shape[-1]) // 2, psfs.shape[-1]
    found[0].copy_(columns.mT.flip((-2, -1))[..., extra : extra + side, extra : extra + side])
    return found


def _refuse(ctx: Any, gradient: Tensor) -> NoReturn:
    raise NotImplementedError(
        "kornia_tidy::occlusion_direct has no gradient: call kornia_tidy.render.occlusion, which makes it by tiles"
    )


torch.library.impl("kornia_tidy::occlusion_direct", "CPU", _occlude)
torch.library.register_fake("kornia_tidy::occlusion_direct", _new_light)
torch.library.impl("kornia_tidy::occlusion_direct_gradients", "CPU", _gradients)
torch.library.register_fake("kornia_tidy::occlusion_direct_gradients", _new_gradients)
torch.library.register_autograd("kornia_tidy::occlusion_direct", _refuse)
