"""Occlusion by direct convolution."""

from __future__ import annotations

import ctypes
from pathlib import Path

import torch
from torch import Tensor

from kornia_tidy.scene.compiled import REALS, compiled

SOURCE = Path(__file__).with_name("occlusion_direct.c")
BAND, STRIP_BYTES = 8, 64  # a block of pixels, see occlusion_direct.c
SMALLEST_SIDE = BAND - 1  # px, of PSFs


class _Panes(ctypes.Structure):
    """The struct ``panes`` in occlusion_direct.c."""

    _fields_ = (
        *((name, ctypes.c_int64) for name in ("images", "channels", "height", "width", "layers", "side", "threads")),
        *((name, ctypes.c_int64) for name in ("plane_image", "plane_channel", "plane_row", "map_image", "map_row")),
        *((name, ctypes.c_void_p) for name in ("plane", "psfs", "lower", "share", "mean", "veil", "out")),
    )


def occlude_directly(
    plane: Tensor,
    psfs: Tensor,
    lower: Tensor,
    fraction: Tensor | None,
    mean: Tensor | None,
    veil: Tensor | None,
    inside: Tensor | None,
) -> Tensor:
    side, dtype = psfs.shape[-1], plane.dtype
    lower = lower.to(dtype)
    if fraction is not None:
        full = fraction == 1
        lower, fraction = (lower + full).contiguous(), fraction.masked_fill(full, 0).contiguous()
    if inside is not None:
        lower = lower.masked_fill(inside == 0, len(psfs))
    lower, plane = lower.contiguous(), plane.contiguous()
    columns = psfs.flip((-2, -1)).transpose(-2, -1).contiguous()
    height, width = (n - side + 1 for n in plane.shape[-2:])
    coded = plane.new_empty(*plane.shape[:2], height, width)
    panes = _Panes(
        images=plane.shape[0],
        channels=plane.shape[1],
        height=height,
        width=width,
        layers=len(psfs),
        side=side,
        threads=torch.get_num_threads(),
        plane_image=plane.stride(0),
        plane_channel=plane.stride(1),
        plane_row=plane.stride(2),
        map_image=lower.stride(0) if len(lower) > 1 else 0,
        map_row=lower.stride(1),
        plane=plane.data_ptr(),
        psfs=columns.data_ptr(),
        lower=lower.data_ptr(),
        out=coded.data_ptr(),
    )
    if fraction is not None:
        panes.share = fraction.data_ptr()
    if mean is not None and veil is not None:
        mean, veil = mean.to(dtype).contiguous(), veil.to(dtype).contiguous()
        panes.mean, panes.veil = mean.data_ptr(), veil.data_ptr()
    if _library(dtype).occlude(ctypes.byref(panes)):
        raise MemoryError(f"no memory to render with PSFs of {side}x{side} pixels")
    return coded


def _library(dtype: torch.dtype) -> ctypes.CDLL:
    library = compiled(SOURCE, dtype)
    assert library is not None
    return library
