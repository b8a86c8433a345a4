"""Direct convolution: what tiles do by transforms, done sample by sample in a processor's vectors.

A block of 4 x 32 pixels (in float32) is convolved with the PSFs of its own layers and with no other: P x P products a
pixel for each. For PSFs of up to some 40 pixels that is faster than transforms, whose tiles are larger and hold more
layers. The work is done in C (``direct.c``), compiled on the machine that it runs on, see
:mod:`kornia_tidy.kernels.build`; where that cannot be, everything goes by tiles.
"""

from __future__ import annotations

import ctypes

import torch
from torch import Tensor

from kornia_tidy.kernels.build import KERNELS, REALS, compiled
from kornia_tidy.render.backends.tile_plan import SAMPLE, Labels, candidates, choose_grid, tile_cost, transforms_cost

SOURCE = KERNELS / "direct.c"
STRIP_ROWS, STRIP_BYTES = 4, 64  # a strip of pixels, see direct.c
SHARED = 0.5  # of the work by transforms that threads share; of direct work it is all
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


def can_go_directly(labels: Labels, dtype: torch.dtype) -> bool:
    """Whether a scene can be convolved directly: on a processor, with a compiler, and planes as large as a block.

    Args:
        labels: the layers of the output's pixels.
        dtype: of the light.
    """
    if labels.lower.device.type != "cpu" or dtype not in REALS:
        return False
    height, width = labels.lower.shape[-2:]
    fits = height >= STRIP_ROWS and width >= 2 * STRIP_BYTES // dtype.itemsize
    return fits and compiled(SOURCE, dtype) is not None


def goes_directly(labels: Labels, layers: int, side: int, dtype: torch.dtype) -> bool:
    """Whether direct convolution is possible, and takes less time than transforms. See :func:`can_go_directly`."""
    if not can_go_directly(labels, dtype):
        return False
    pixels, terms = labels.lower.numel(), 1 if labels.fraction is None else 2
    direct, scale = direct_cost(count_pairs(labels, dtype), side), dtype.itemsize / 4
    # First against tiles that hold one layer each, which need not be looked at.
    windows = min(
        tile_cost(grid.size, grid.blocks, grid.blocks) for grid in candidates(tuple(labels.lower.shape), side)
    )
    if is_direct_faster(direct, scale * transforms_cost(windows, pixels, terms)):
        return True
    grid = choose_grid(labels, layers, side)
    pairs = int(grid.present(labels.every(SAMPLE), layers, SAMPLE).sum())
    windows = tile_cost(grid.size, grid.blocks, pairs)
    return is_direct_faster(direct, scale * transforms_cost(windows, pixels, terms))


def is_direct_faster(direct: float, transforms: float) -> bool:
    """Compare what two ways take on one core: of direct work threads share all, of transforms ``SHARED``."""
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


def mix_directly(plane: Tensor, psfs: Tensor, labels: Labels, *, slope: bool = False) -> Tensor:
    """Let each pixel take the light that it sees through the PSFs of its own layers.

    Args:
        plane: (B, C, H + P - 1, W + P - 1) light.
        psfs: (D, C, P, P) of the plane's dtype.
        labels: the layers of each pixel, (B, H, W).
        slope: instead, what a pixel would gain by moving from its lower layer to the next.

    Returns:
        (B, C, H, W).

    Raises:
        IndexError: if a pixel lies in no layer.
    """
    batch, channels = plane.shape[:2]
    plane = _rows(plane)
    columns = psfs.flip((-2, -1)).transpose(-2, -1).contiguous()
    mixed = plane.new_empty(batch, channels, *labels.lower.shape[-2:])
    scene, kept = _scene(plane, psfs.shape, labels)
    scene.psfs, scene.out, scene.slope = columns.data_ptr(), mixed.data_ptr(), slope
    if _library(plane.dtype).mix(ctypes.byref(scene)):
        raise IndexError(f"a pixel lies in none of the {len(psfs)} layers: its depth or defocus is not a number")
    del kept
    return mixed


def correlate_directly(plane: Tensor, own: Tensor, labels: Labels, shape: torch.Size) -> Tensor:
    """Correlate each layer's own pixels with the light that they see: the gradient of PSFs.

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
    plane = torch.empty((), dtype=dtype).expand(len(labels.lower), 1, 1, 1)
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
    """Pixels of a row must lie side by side."""
    return plane if plane.stride(-1) == 1 else plane.contiguous()


def _scene(plane: Tensor, shape: torch.Size, labels: Labels) -> tuple[_Scene, list[Tensor]]:
    """Return what direct.c is told, and the tensors whose memory it names."""
    lower = _rows(labels.lower)
    share = None if labels.fraction is None else _rows(labels.fraction.to(plane.dtype))
    scene = _Scene(
        images=plane.shape[0],
        channels=plane.shape[1],
        height=lower.shape[-2],
        width=lower.shape[-1],
        layers=shape[0],
        side=shape[-1],
        threads=torch.get_num_threads(),
        plane_image=plane.stride(0),
        plane_channel=plane.stride(1),
        plane_row=plane.stride(2),
        lower_image=lower.stride(0),
        lower_row=lower.stride(1),
        plane=plane.data_ptr(),
        lower=lower.data_ptr(),
    )
    if share is not None:
        scene.share_image, scene.share_row, scene.share = share.stride(0), share.stride(1), share.data_ptr()
    return scene, [plane, lower] if share is None else [plane, lower, share]
