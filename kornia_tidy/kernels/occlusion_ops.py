"""Operator of occlusion by direct convolution: in C.

Sums are of positive terms only, so float32 keeps their relative accuracy however small the divisor that they become.
A second operator makes the gradients of light, PSFs and stray light. Those of the layers the renderer makes by tiles.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from kornia_tidy.kernels.build import KERNELS, load, vector_bytes
from kornia_tidy.kernels.operators import call, check, operator, strided
from kornia_tidy.kernels.places import fields_of, of_axis
from kornia_tidy.kernels.scene_checks import check_light, check_smallest, output_of
from kornia_tidy.kernels.window_sides import size_step

SOURCE = KERNELS / "occlusion.c"
BLOCK_ROWS = 8  # of a block of pixels, see occlusion.c
TILE = (8, 16)  # largest rows and columns of a tile with a PSF over the field: a block of the widest vectors
EPSILON = 1e-6  # added to the divisor, see occlusion.c
SMALLEST_SIDE = BLOCK_ROWS - 1  # px, of PSFs; smaller ones are padded to it
# Operations for each pixel of a block, as many as take as long: to begin and end the sums of a layer, for a column of a
# PSF that meets a row of light, and for an end of a run of whole weights.
_BLOCK, _COLUMN, _END = 170, 1, 3


@operator()
def occlusion_direct(
    plane: Tensor,
    psfs: Tensor,
    layer_index: Tensor,
    layer_weight: Tensor | None = None,
    mean: Tensor | None = None,
    stray_light: Tensor | None = None,
    inside: Tensor | None = None,
    places: Sequence[Tensor] | None = None,
) -> Iterator[Tensor]:
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
    light = _new_light(plane, psfs, layer_index, layer_weight, mean, stray_light, inside, places)
    yield light
    scene = _fields(plane, psfs, layer_index, layer_weight, inside, places)
    call(load(SOURCE, light.dtype).occlude, *scene, mean, stray_light, light, *(None,) * 7)


@operator()
def occlusion_direct_gradients(
    plane: Tensor,
    psfs: Tensor,
    layer_index: Tensor,
    layer_weight: Tensor | None,
    mean: Tensor | None,
    stray_light: Tensor | None,
    inside: Tensor | None,
    places: Sequence[Tensor] | None,
    gradient: Tensor,
    wanted: Sequence[bool],
) -> Iterator[list[Tensor]]:
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
        places: as there.
        gradient: (B, C, H, W) of the light, of the plane's dtype.
        wanted: which gradients: of the plane, of the PSFs, of ``mean`` and of ``stray_light``.

    Returns:
        The gradients wanted of the tensors that are not None. They have none.

    Raises:
        TypeError: as there.
        ValueError: as there, or if the gradient does not fit.
        MemoryError: as there.
        NotBuiltError: as there.
    """
    light = _new_light(plane, psfs, layer_index, layer_weight, mean, stray_light, inside, places)
    check(dict(zip("BCHW", light.shape, strict=True)), light.dtype, gradient=(gradient, "B C H W"))
    tensors = plane, psfs, mean, stray_light
    found = [x.new_empty(x.shape) if want and x is not None else None for x, want in zip(tensors, wanted, strict=True)]
    yield [x for x in found if x is not None]
    extra = _rim(psfs)
    own = [x if x is None else x.new_empty(*x.shape[:-2], *(n + 2 * extra for n in x.shape[-2:])) for x in found[:2]]
    scene = _fields(plane, psfs, layer_index, layer_weight, inside, places)
    results = None, gradient, *own, *found[2:], None, 0
    call(load(SOURCE, light.dtype).occlusion_gradients, *scene, mean, stray_light, *results)
    for x, made in zip(found[:2], own, strict=True):
        if x is not None and made is not None:
            turned = made.mT.flip((-2, -1)) if x is found[1] else made
            x.copy_(turned[..., extra : extra + x.shape[-2], extra : extra + x.shape[-1]])


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
    scene = _fields(plane, psfs[:, :1], layer_index, layer_weight)
    every, counts = max(1, batch * output_of(plane, psfs)[2] // (BLOCK_ROWS * bands)), torch.zeros(3, dtype=torch.int64)
    library = load(SOURCE, psfs.dtype)
    call(library.count, *scene, *(None,) * 8, counts, every)
    pairs, columns, ends = counts.tolist()  # pairs of a block and a layer, ...
    of_pixel = pairs * _BLOCK + columns * _COLUMN + ends * _END
    return float(every * BLOCK_ROWS * vector_bytes(library) // psfs.itemsize * of_pixel)


def smallest_output(dtype: torch.dtype) -> tuple[int, int]:
    """Return the rows and columns of a block, below which an image is too small.

    Example:
        >>> smallest_output(torch.float32), smallest_output(torch.float64)
        ((8, 32), (8, 16))
    """
    return BLOCK_ROWS, size_step(dtype)


def _new_light(
    plane: Tensor,
    psfs: Tensor,
    layer_index: Tensor,
    layer_weight: Tensor | None,
    mean: Tensor | None,
    stray_light: Tensor | None,
    inside: Tensor | None,
    places: Sequence[Tensor] | None,
) -> Tensor:
    """Check a scene and return the memory of its light."""
    psfs = of_axis(psfs, places)
    sizes = check_light("plane", plane, "Y X", psfs)
    light = plane.new_empty(output_of(plane, psfs))
    check_smallest(light.shape, smallest_output(plane.dtype))
    of_maps = "1 Y X" if len(layer_index) == 1 else "B Y X"
    check(sizes, None, layer_index=(layer_index, of_maps), inside=(inside, "1 Y X"))
    if (mean is None) != (stray_light is None):
        only = "stray_light" if mean is None else "mean"
        raise ValueError(f"stray_light needs a mean and a mean needs stray_light, got only {only}")
    if places and stray_light is not None:
        raise ValueError("stray_light must be None where PSFs vary over the field")
    planes = {"mean": (mean, "B C"), "stray_light": (stray_light, "D C")}
    check(sizes, plane.dtype, layer_weight=(layer_weight, of_maps), **planes)
    return light


def _rim(psfs: Tensor) -> int:
    """Return the pixels that PSFs are padded by on each side."""
    return max(0, SMALLEST_SIDE - psfs.shape[-1]) // 2


def _fields(
    plane: Tensor,
    psfs: Tensor,
    layer_index: Tensor,
    layer_weight: Tensor | None,
    inside: Tensor | None = None,
    places: Sequence[Tensor] | None = None,
) -> tuple[Any, ...]:
    """Return the fields of a scene in occlusion.c up to its layers' weights."""
    index, weight = layer_index.to(plane.dtype), layer_weight
    if weight is not None:  # a pixel with a weight of one lies in the next layer alone
        full = weight == 1
        index, weight = index + full, weight.detach().to(plane.dtype).masked_fill(full, 0)
    if inside is not None:
        index = index.masked_fill(inside == 0, psfs.shape[-4])
    extra = (_rim(psfs),) * 4
    if extra[0]:  # no light comes from there
        psfs, plane, index = pad(psfs, extra), pad(plane, extra), pad(index, extra, mode="replicate")
        weight = None if weight is None else pad(weight, extra, mode="replicate")
    size = output_of(plane, psfs)
    numbers = *size, *psfs.shape[-4::3], index.shape[1] * index.shape[2] * (len(index) > 1), index.shape[2]
    field = fields_of(places, size[2:], TILE, plane.dtype)
    return *numbers, *field, strided(plane.contiguous()), psfs.flip((-2, -1)).mT, index, weight
