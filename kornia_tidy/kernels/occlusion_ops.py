"""Operator of occlusion by direct convolution: in C.

Sums are of positive terms only, so float32 keeps their relative accuracy however small the divisor that they become.
A second operator makes the gradients of light, PSFs and stray light. Those of the layers the renderer makes by tiles.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from kornia_tidy.kernels.build import KERNELS, load, vector_bytes
from kornia_tidy.kernels.operators import Parameters, define
from kornia_tidy.kernels.places import PLACES, of_axis, parameters_of
from kornia_tidy.kernels.scene_checks import check_dtypes, check_light, check_psfs, check_shape, check_smallest
from kornia_tidy.kernels.window_sides import size_step

SOURCE = KERNELS / "occlusion.c"
BLOCK_ROWS = 8  # of a block of pixels, see occlusion.c
TILE = (8, 16)  # largest rows and columns of a tile with a PSF over the field: a block of the widest vectors
EPSILON = 1e-6  # added to the divisor, see occlusion.c
SMALLEST_SIDE = BLOCK_ROWS - 1  # px, of PSFs; smaller ones are padded to it
# Operations for each pixel of a block, as many as take as long: to begin and end the sums of a layer, for a column of a
# PSF that meets a row of light, and for an end of a run of whole weights.
_BLOCK, _COLUMN, _END = 170, 1, 3


def occlusion_direct(
    plane: Tensor,
    psfs: Tensor,
    layer_index: Tensor,
    layer_weight: Tensor | None = None,
    mean: Tensor | None = None,
    stray_light: Tensor | None = None,
    inside: Tensor | None = None,
    places: Sequence[Tensor] = (),
) -> Tensor:
    """Render layers that hide one another by direct convolution: operator ``kornia_tidy::occlusion_direct``.

    Args:
        plane: (B, C, H + P - 1, W + P - 1) image on a processor, with all that lies beyond its border; float32
            or float64.
        psfs: (D, C, P, P) with P odd, of the plane's dtype, not negative anywhere. Layer D - 1 is the nearest. With
            ``places`` (I, J, D, C, P, P): they are normalised but for their light, which an even scene then takes on.
        layer_index: (B or 1, H + P - 1, W + P - 1) layer of each pixel, whole numbers of any dtype.
        layer_weight: share of the next layer in [0, 1], of the same shape and the plane's dtype, or None for zero.
        mean: (B, C) mean light of each image, and
        stray_light: (D, C) share of it that each layer takes on; both or none.
        inside: (1, H + P - 1, W + P - 1) 1 on the image and 0 in the dark beyond it, or None for no dark.
        places: :class:`~kornia_tidy.kernels.places.Places` of PSFs that vary over the field, with tiles of at most
            :data:`TILE`. Default: PSFs are the same everywhere.

    Returns:
        (B, C, H, W). It has no gradient.

    Raises:
        TypeError: if a data type is not as above.
        ValueError: if shapes do not fit, or the output is smaller than a block of 8 x 32 (float64: 8 x 16) pixels; GPUs
            take any size.
        MemoryError: if memory for the tables is missing.
        NotBuiltError: if the source cannot be compiled.
    """
    scene = plane, psfs, layer_index, layer_weight, mean, stray_light, inside
    return torch.ops.kornia_tidy.occlusion_direct(*scene, list(places))


def occlusion_direct_gradients(
    plane: Tensor,
    psfs: Tensor,
    layer_index: Tensor,
    layer_weight: Tensor | None,
    mean: Tensor | None,
    stray_light: Tensor | None,
    inside: Tensor | None,
    gradient: Tensor,
    places: Sequence[Tensor] = (),
    wanted: Sequence[bool] = (False, True, False, True),
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
        places: as there.
        wanted: which gradients: of the plane, of the PSFs, of ``mean`` and of ``stray_light``.

    Returns:
        The gradients wanted of the tensors that are not None. They have none.

    Raises:
        TypeError: as there.
        ValueError: as there, or if the gradient does not fit, or more than that of the PSFs is wanted with ``places``.
        MemoryError: as there.
        NotBuiltError: as there.
    """
    scene = plane, psfs, layer_index, layer_weight, mean, stray_light, inside
    return torch.ops.kornia_tidy.occlusion_direct_gradients(*scene, list(places), gradient, list(wanted))


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
    scene = _parameters(plane, psfs[:, :1], layer_index, layer_weight)
    every = max(1, scene.images * scene.height // (BLOCK_ROWS * bands))
    counts, library = (ctypes.c_int64 * 4)(), load(SOURCE, psfs.dtype)
    if library.count(ctypes.byref(scene), ctypes.c_int64(every), counts):
        raise MemoryError(f"no memory to render with PSFs of {scene.side}x{scene.side} pixels")
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


class _Scene(Parameters):
    """The struct ``scene_parameters`` in occlusion.c."""

    _fields_ = (
        *((name, ctypes.c_int64) for name in ("images", "channels", "height", "width", "layers", "side", "threads")),
        *((name, ctypes.c_int64) for name in ("plane_image", "plane_channel", "plane_row", "map_image", "map_row")),
        *((name, ctypes.c_void_p) for name in ("plane", "psfs", "index", "weight", "mean", "stray_light", "out")),
        *((name, ctypes.c_void_p) for name in ("gradient", "of_psfs", "of_stray_light", "of_plane", "of_mean")),
        *PLACES,
    )


def _parameters(
    plane: Tensor,
    psfs: Tensor,
    layer_index: Tensor,
    layer_weight: Tensor | None,
    mean: Tensor | None = None,
    stray_light: Tensor | None = None,
    inside: Tensor | None = None,
    places: Sequence[Tensor] = (),
) -> _Scene:
    index, weight = layer_index.to(plane.dtype), layer_weight
    if weight is not None:  # a pixel with a weight of one lies in the next layer alone
        full = weight == 1
        index, weight = index + full, weight.detach().to(plane.dtype).masked_fill(full, 0)
    if inside is not None:
        index = index.masked_fill(inside == 0, psfs.shape[-4])
    extra = (max(0, SMALLEST_SIDE - psfs.shape[-1]) // 2,) * 4
    if extra[0]:  # no light comes from there
        psfs, plane, index = pad(psfs, extra), pad(plane, extra), pad(index, extra, mode="replicate")
        weight = None if weight is None else pad(weight, extra, mode="replicate")
    side = psfs.shape[-1]
    size = plane.shape[2] - side + 1, plane.shape[3] - side + 1
    numbers, tensors = parameters_of(list(places), size, TILE, plane.dtype) if places else ({}, {})
    scene = _Scene(
        images=plane.shape[0],
        channels=plane.shape[1],
        height=size[0],
        width=size[1],
        layers=psfs.shape[-4],
        side=side,
        map_image=index[0].numel() if len(index) > 1 else 0,
        map_row=index.shape[2],
        **numbers,
    )
    scene.point_to(plane=plane.contiguous(), psfs=psfs.flip((-2, -1)).mT, index=index, weight=weight)
    scene.point_to(mean=mean, stray_light=stray_light, **tensors)
    return scene


def _new_light(*scene: Any) -> Tensor:
    """Check a scene and return the memory of its light, which is also the fake implementation."""
    plane, psfs, layer_index, layer_weight, mean, stray_light, inside, places = scene
    psfs = of_axis(psfs, places)
    check_light("plane", plane)
    check_dtypes(plane, layer_weight=layer_weight, mean=mean, stray_light=stray_light)
    check_psfs(psfs, plane)
    batch, channels, rows, columns = plane.shape
    light = batch, channels, rows - psfs.shape[-1] + 1, columns - psfs.shape[-1] + 1
    check_smallest(light, smallest_output(plane.dtype))
    check_shape("layer_index", layer_index, (batch, rows, columns), (1, rows, columns))
    if (mean is None) != (stray_light is None):
        only = "stray_light" if mean is None else "mean"
        raise ValueError(f"stray_light needs a mean and a mean needs stray_light, got only {only}")
    if places and stray_light is not None:
        raise ValueError("stray_light must be None where PSFs vary over the field")
    check_shape("layer_weight", layer_weight, tuple(layer_index.shape))
    check_shape("mean", mean, (batch, channels))
    check_shape("stray_light", stray_light, (psfs.shape[0], channels))
    check_shape("inside", inside, (1, rows, columns))
    return plane.new_empty(light)


def _occlude(*scene: Any) -> Tensor:
    light, parameters = _new_light(*scene), _parameters(*scene)
    parameters.point_to(out=light)
    if load(SOURCE, light.dtype).occlude(ctypes.byref(parameters)):
        raise MemoryError(f"no memory to render with PSFs of {parameters.side}x{parameters.side} pixels")
    return light


_WITH_GRADIENTS = {"plane": 0, "psfs": 1, "mean": 4, "stray_light": 5}  # names, and places among the arguments


def _new_gradients(*given: Any) -> list[Tensor]:
    *scene, gradient, wanted = given
    light = _new_light(*scene)
    check_dtypes(light, gradient=gradient)
    check_shape("gradient", gradient, tuple(light.shape))
    if scene[-1] and (wanted[0] or wanted[2]):
        raise ValueError("places must be empty where the gradient of the plane or of its mean is wanted")
    tensors = (scene[n] for n in _WITH_GRADIENTS.values())
    return [x.new_empty(x.shape) for x, want in zip(tensors, wanted, strict=True) if want and x is not None]


def _gradients(*given: Any) -> list[Tensor]:
    *scene, gradient, wanted = given
    found, parameters = _new_gradients(*given), _parameters(*scene)
    extra = (parameters.side - scene[1].shape[-1]) // 2
    parts = zip(_WITH_GRADIENTS.items(), wanted, strict=True)
    names = [name for (name, n), want in parts if want and scene[n] is not None]
    own = {"gradient": gradient}
    for name, x in zip(names, found, strict=True):
        planes = name in {"plane", "psfs"}  # these have a rim where PSFs were padded
        own[f"of_{name}"] = x.new_empty(*x.shape[:-2], *(n + 2 * extra for n in x.shape[-2:])) if planes else x
    parameters.point_to(**own)
    if load(SOURCE, gradient.dtype).occlusion_gradients(ctypes.byref(parameters)):
        raise MemoryError(f"no memory for gradients of PSFs of {parameters.side}x{parameters.side} pixels")
    for name, x in zip(names, found, strict=True):
        made = own[f"of_{name}"]
        if name == "psfs":
            made = made.mT.flip((-2, -1))
        if made is not x:
            x.copy_(made[..., extra : extra + x.shape[-2], extra : extra + x.shape[-1]])
    return found


_SCENE = (
    "Tensor plane, Tensor psfs, Tensor layer_index, Tensor? layer_weight, Tensor? mean, Tensor? stray_light,"
    " Tensor? inside, Tensor[] places"
)
define("occlusion_direct", f"({_SCENE}) -> Tensor", _occlude, _new_light)
_GRADIENTS = f"({_SCENE}, Tensor gradient, bool[] wanted) -> Tensor[]"
define("occlusion_direct_gradients", _GRADIENTS, _gradients, _new_gradients)
