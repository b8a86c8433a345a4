"""Occlusion by direct convolution: what tiles do by transforms, done sample by sample in a processor's vectors.

A block of 8 x 16 pixels (in float32) meets the layers in its window, each only in the rows and columns where it is. All
that is added up is positive, so float32 is enough: no sum is off by more than a share of itself, however small the
divisor that it becomes. Whole weights along runs of pixels are not even convolved: their blur is known from where runs
begin and end. The work is done in C (``occlusion.c``), see :mod:`kornia_tidy.kernels.build`; where that cannot
be, everything goes by tiles.
"""

from __future__ import annotations

import ctypes

import torch
from torch import Tensor
from torch.nn.functional import pad

from kornia_tidy.kernels.build import KERNELS, REALS, compiled
from kornia_tidy.render.backends.direct import SHARED
from kornia_tidy.render.backends.occlusion_tile_plan import candidates
from kornia_tidy.render.backends.tile_plan import SAMPLE, Labels

SOURCE = KERNELS / "occlusion.c"
BAND, STRIP_BYTES = 8, 64  # a block of pixels, see occlusion.c
SMALLEST_SIDE = BAND - 1  # px, of PSFs; smaller ones are made as large
NEGATIVE = 1e-4  # of a PSF: over EPSILON it makes a float32's round-off 1e-5
COUNTED = 12  # bands of blocks, of which costs are known


class _Panes(ctypes.Structure):
    """The struct ``panes`` in occlusion.c."""

    _fields_ = (
        *((name, ctypes.c_int64) for name in ("images", "channels", "height", "width", "layers", "side", "threads")),
        *((name, ctypes.c_int64) for name in ("plane_image", "plane_channel", "plane_row", "map_image", "map_row")),
        *((name, ctypes.c_void_p) for name in ("plane", "psfs", "lower", "share", "mean", "veil", "out")),
    )


def can_go_directly(plane: Tensor, psfs: Tensor) -> bool:
    """Whether there is a way to do this directly: on a processor, with a compiler, and a plane large enough.

    Sums keep their relative accuracy only where what is added up is positive.

    Args:
        plane: (B, C, H + P - 1, W + P - 1) light.
        psfs: (D, C, P, P).
    """
    side = psfs.shape[-1]
    if psfs.device.type != "cpu" or psfs.dtype not in REALS or psfs.dtype != plane.dtype:
        return False
    height, width = (n - side + 1 for n in plane.shape[-2:])
    fits = height >= BAND and width >= 2 * STRIP_BYTES // psfs.element_size()
    negative = psfs.detach().clamp(max=0).sum((-2, -1)) < -NEGATIVE
    return fits and not bool(negative.any()) and compiled(SOURCE, psfs.dtype) is not None


def goes_directly(plane: Tensor, psfs: Tensor, lower: Tensor, fraction: Tensor | None) -> bool:
    """Whether this is possible, and takes less time than tiles. See :func:`can_go_directly`.

    Args:
        plane: (B, C, H + P - 1, W + P - 1) light.
        psfs: (D, C, P, P).
        lower: (B or 1, H + P - 1, W + P - 1) layer of each pixel, and
        fraction: share of the next one, or None.
    """
    if not can_go_directly(plane, psfs):
        return False
    batch, side, threads = len(plane), psfs.shape[-1], torch.get_num_threads()
    direct = direct_cost(*count(plane, psfs, lower, fraction), max(side, SMALLEST_SIDE)) / threads
    sample = Labels(lower, None if fraction is None else fraction.detach()).every(SAMPLE)
    labels = [label.long().expand(batch, -1, -1) for label in sample.terms()]
    output = (plane.shape[-2] - side + 1, plane.shape[-1] - side + 1)
    tiles, _ = candidates(labels, output, len(psfs), side)[0]
    return direct < tiles * (1 - SHARED + SHARED / threads)


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


def count(plane: Tensor, psfs: Tensor, lower: Tensor, fraction: Tensor | None) -> list[int]:
    """Return what :func:`direct_cost` wants to know, from every few bands of blocks."""
    panes, kept = _panes(plane, psfs, lower, fraction, None)
    every = max(1, panes.images * panes.height // (BAND * COUNTED))
    counts = (ctypes.c_int64 * 4)()
    if _library(plane.dtype).count(ctypes.byref(panes), ctypes.c_int64(every), counts):
        raise MemoryError(f"no memory to render with PSFs of {panes.side}x{panes.side} pixels")
    del kept
    return [every * number for number in counts]


def occlude_directly(
    plane: Tensor,
    psfs: Tensor,
    lower: Tensor,
    fraction: Tensor | None,
    mean: Tensor | None,
    veil: Tensor | None,
    inside: Tensor | None,
) -> Tensor:
    """Render with occlusion. See :func:`kornia_tidy.render.backends.dense_occlusion.occlude_dense`, which it equals.

    Args:
        plane: (B, C, H + P - 1, W + P - 1) image, with all that lies beyond its border.
        psfs: (D, C, P, P) of the plane's dtype, not negative anywhere.
        lower: (B or 1, H + P - 1, W + P - 1) layer of each pixel, in any dtype, and
        fraction: share of the next one, or None.
        mean: (B, C) mean light of each image, and
        veil: (D, C) how much of it each layer takes on; or None.
        inside: (1, H + P - 1, W + P - 1) 1 on the image and 0 in the dark beyond it, or None for no dark.

    Returns:
        (B, C, H, W).
    """
    panes, kept = _panes(plane, psfs, lower, fraction, inside)
    coded = plane.new_empty(*plane.shape[:2], panes.height, panes.width)
    panes.out = coded.data_ptr()
    if mean is not None and veil is not None:  # both or none
        kept += [mean.to(plane.dtype).contiguous(), veil.to(plane.dtype).contiguous()]
        panes.mean, panes.veil = (x.data_ptr() for x in kept[-2:])
    if _library(plane.dtype).occlude(ctypes.byref(panes)):
        raise MemoryError(f"no memory to render with PSFs of {panes.side}x{panes.side} pixels")
    del kept
    return coded


def _library(dtype: torch.dtype) -> ctypes.CDLL:
    library = compiled(SOURCE, dtype)
    assert library is not None
    return library


def _panes(
    plane: Tensor, psfs: Tensor, lower: Tensor, fraction: Tensor | None, inside: Tensor | None
) -> tuple[_Panes, list[Tensor]]:
    """Return what occlusion.c is told of a scene, and the tensors whose memory it names."""
    lower = lower.to(plane.dtype)
    if fraction is not None:  # what lies in one layer alone lies in `lower`
        full = fraction == 1
        lower, fraction = lower + full, fraction.detach().to(plane.dtype).masked_fill(full, 0)
    if inside is not None:
        lower = lower.masked_fill(inside == 0, len(psfs))
    extra = (max(0, SMALLEST_SIDE - psfs.shape[-1]) // 2,) * 4
    if extra[0]:  # no light comes from there
        psfs, plane, lower = pad(psfs, extra), pad(plane, extra), pad(lower, extra, mode="replicate")
        fraction = None if fraction is None else pad(fraction, extra, mode="replicate")
    plane, lower, columns = (x.contiguous() for x in (plane, lower, psfs.flip((-2, -1)).transpose(-2, -1)))
    panes = _Panes(
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
        map_image=lower.stride(0) if len(lower) > 1 else 0,
        map_row=lower.stride(1),
        plane=plane.data_ptr(),
        psfs=columns.data_ptr(),
        lower=lower.data_ptr(),
    )
    if fraction is None:
        return panes, [plane, lower, columns]
    fraction = fraction.contiguous()
    panes.share = fraction.data_ptr()
    return panes, [plane, lower, columns, fraction]
