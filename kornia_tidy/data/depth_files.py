"""Depth files: depth in metres and a validity mask, from stored depth or disparity."""

from __future__ import annotations

import math
import os
from collections.abc import Collection
from pathlib import Path
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from kornia_tidy.arrays import check_depth_scale
from kornia_tidy.checks import check_choice, check_depth, check_float_tensor, check_positive
from kornia_tidy.data.metadata import with_text
from kornia_tidy.data.npy import encode_npy
from kornia_tidy.data.orientation import tell_orientation
from kornia_tidy.data.pfm import encode_pfm
from kornia_tidy.data.stored import read_stored
from kornia_tidy.files import write_bytes
from kornia_tidy.optics.holes import fill_holes
from kornia_tidy.optics.units import warn_once

# Largest numbers of data types, which often mark unknown depth.
UNKNOWN: dict[Any, float] = {np.dtype(kind): int(np.iinfo(kind).max) for kind in ("u2", "i2", "u4", "i4", "u8", "i8")}
UNKNOWN |= {np.dtype(kind): float(np.finfo(kind).max) for kind in ("f2", "f4", "f8")}
BASELINES = (1e-3, 10.0)  # m; a pair farther apart or nearer is rather given in another unit
NEAR_DISPARITY = 5.0  # a larger median is taken for disparity in pixels, a smaller one for metres


class DepthMap(NamedTuple):
    """Depth without holes, and the mask of measured pixels."""

    depth: Tensor
    """(1, H, W) float32 in metres, positive, maybe infinite. Holes have the value of the nearest known pixel."""
    valid: Tensor
    """(1, H, W) bool, False in holes."""


def read_depth(
    path: str | os.PathLike[str],
    scale: float = 1.0,
    *,
    kind: Literal["depth", "disparity", "distance"] = "depth",
    invalid: Collection[float] = (),
    focal_px: float | None = None,
    baseline_m: float | None = None,
    doffs_px: float = 0.0,
    rotated_bits: int = 0,
) -> DepthMap:
    r"""Read a depth map in metres, with holes marked in a mask and filled from the nearest known pixel.

    Stored values v are depth, :math:`z = s v`, disparity, :math:`z = f B / (s v + d)`, or the distance along the ray
    to a pixel x, y from the middle of the image, :math:`z = s v f / \sqrt{f^2 + x^2 + y^2}`.

    Args:
        path: a PNG, TIFF, PGM, PAM, PFM, NPY, NPZ, HDF5 or OpenEXR file. It has one channel, and an array is (H, W) and
            is never unpickled; an NPZ archive and an HDF5 file hold one array; see
            :func:`~kornia_tidy.data.exr.decode_exr` for the channel of an OpenEXR file.
        scale: s, metres or pixels of disparity per stored unit; 0.001 for millimetres, where other programs say 1000
            units per metre.
        kind: quantity that is stored.
        invalid: stored values that mean *unknown*, besides those under Convention.
        focal_px: f, focal length in pixels; disparity and distance only.
        baseline_m: B, distance between the two cameras in metres; disparity only.
        doffs_px: d, difference of the principal points in pixels; disparity only.
        rotated_bits: number of bits by which stored 16-bit values were rotated to the left; 3 for SUN RGB-D.

    Returns:
        The depth and where it is valid, each :math:`(1, H, W)`.

    Raises:
        FileNotFoundError: if the file is missing.
        ValueError: if the file is not an image, is cut short or damaged, or has several channels or no valid pixel; if
            disparity comes without calibration or depth with one; if a number is not positive; or if the scale is
            units per metre.

    Convention:
        - Always unknown: NaN, a stored integer 0 (as Kinect, KITTI and Middlebury mean it), depth of 0 or less, and
          disparity that is infinite or, with d added, negative.
        - Unknown in a TIFF: pixels with GDAL's missing value, behind a mask, transparent, or left out of the file; see
          :func:`~kornia_tidy.data.tiff.decode_tiff`. In HDF5: ``_FillValue``, ``missing_value`` and numbers outside
          ``valid_range``. A factor or unit that the file gives for its numbers is not applied. A warning, once per
          folder, names it if ``scale`` is another.
        - Infinite depth is valid, such as a sky, and so is a floating-point disparity that is 0 with d added. List
          them in ``invalid`` for a data set that means *unknown* by them.
        - A warning, once per folder, names values that look like *unknown* and are not listed: the largest of the data
          type, such as 65535, far above all others; in a PFM file infinity below values as large as disparities.
        - Renderers write 1e10 (Blender) or infinity where a ray hits nothing. Both are depths, and to a lens the same.
        - Transparent pixels of PNG and PAM files are unknown, by alpha or, as GDAL means it, by their grey level.
        - The orientation of a file is not applied. A warning, once per folder, size and orientation, tells of it.
        - A hole takes the value of the nearest known pixel; see :func:`~kornia_tidy.data.fill_holes`.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     np.save(f"{folder}/depth.npy", np.array([[500, 0, 0, 2000]], np.uint16))
        ...     depth, valid = read_depth(f"{folder}/depth.npy", scale=0.001)
        >>> depth, valid
        (tensor([[[0.5000, 0.5000, 2.0000, 2.0000]]]), tensor([[[ True, False, False,  True]]]))
    """
    calibration: dict[str, Any] = {"focal_px": focal_px, "baseline_m": baseline_m, "doffs_px": doffs_px}
    check_depth_options(scale, kind=kind, **calibration, rotated_bits=rotated_bits)
    file = read_stored(path, depth=True)
    tell_orientation(path, file.orientation, file.values.shape[:2], "depth")
    stored = file.values
    if stored.shape[2] != 1:
        raise ValueError(f"cannot read {path}: depth has one channel, this has {stored.shape[2]}")
    stored = stored[..., 0]
    if rotated_bits:
        if stored.dtype != np.uint16:
            raise ValueError(f"cannot read {path}: rotated_bits is for 16-bit values, these are {stored.dtype}")
        stored = (stored >> int(rotated_bits)) | (stored << (16 - int(rotated_bits)))
    _tell_of_scale(path, file.scale, scale)
    _tell_of_unknown(path, stored if file.unknown is None else stored[~file.unknown][:, None], kind, invalid)
    known = stored != 0 if stored.dtype.kind in "ui" else ~np.isnan(stored)
    if file.unknown is not None:
        known &= ~file.unknown
    for value in invalid:
        known &= stored != value
    if kind != "disparity":
        check_depth_scale(scale, stored[known])
    metres = stored.astype(np.float64) * scale
    if kind == "distance" and focal_px is not None:
        metres *= ray_cosine(metres.shape, focal_px)
    elif focal_px is not None and baseline_m is not None:
        metres = _disparity_to_depth(metres + doffs_px, focal_px * baseline_m)
    with np.errstate(over="ignore"):
        depth = metres.astype(np.float32)
    known &= depth > 0
    if not known.any():
        raise ValueError(f"cannot read {path}: it has no valid {kind} at any pixel")
    filled, _ = fill_holes(np.ma.masked_array(depth, ~known))
    return DepthMap(torch.from_numpy(filled)[None], torch.from_numpy(known)[None])


def _tell_of_scale(path: str | os.PathLike[str], of_file: float, scale: float) -> None:
    """Warn once per folder of a file that gives another factor for its numbers than the caller."""
    if not math.isclose(of_file, 1) and not math.isclose(of_file, scale, rel_tol=1e-6):
        warn_once(
            None,
            ("scale", Path(path).parent),
            f"{path} says that its numbers are to be multiplied by {of_file:.9g}, and scale is {scale:.9g}: if that "
            f"gives metres, give scale={of_file:.9g} (--depth-scale {of_file:.9g})",
            stacklevel=4,
        )


def _tell_of_unknown(path: str | os.PathLike[str], stored: NDArray[Any], kind: str, invalid: Collection[float]) -> None:
    """Warn once per folder of values that usually mean *unknown* and would be read as depth."""
    if kind != "depth":
        return
    path = Path(path)
    mark = UNKNOWN.get(stored.dtype)
    if mark is not None and mark not in invalid and bool((full := stored == mark).any()):
        others = float(stored[~full & np.isfinite(stored)].max(initial=0))
        # It is a depth if other depths reach up to it, or if write_depth wrote the file.
        if others < 0.9 * mark and b"tEXtdepth_scale\0" not in path.read_bytes()[:1024]:
            warn_once(
                None,
                (mark, path.parent),
                f"{path} holds {mark:.10g} where its other values end at {others:g}, and it is taken for a depth: if "
                f"it means 'unknown', give invalid=[{mark:.10g}] (--invalid {mark:.10g})",
                stacklevel=4,
            )
    if path.suffix.lower() == ".pfm" and not any(np.isinf(value) for value in invalid):
        endless = np.isinf(stored)
        # A sky reaches the top of the picture; 96 to 100 % of the holes in Middlebury's files lie below known pixels.
        holes = endless & np.maximum.accumulate(~endless, axis=0)
        known = stored[np.isfinite(stored)]
        if 2 * holes.sum() > endless.sum() and np.median(known) > NEAR_DISPARITY:
            warn_once(
                None,
                ("inf", path.parent),
                f"{path} holds infinity, which is taken for a depth in metres: if it is a disparity, as Middlebury's, "
                f"give kind='disparity' and invalid=[inf] with its calibration (--depth-kind disparity --invalid inf); "
                f"if infinity means 'unknown', invalid=[inf]",
                stacklevel=4,
            )


def check_depth_options(
    scale: float = 1.0,
    *,
    kind: str = "depth",
    focal_px: float | None = None,
    baseline_m: float | None = None,
    doffs_px: float = 0.0,
    rotated_bits: int = 0,
) -> None:
    """Raise ``ValueError`` if options of :func:`read_depth` contradict each other.

    Raises:
        ValueError: if disparity or distance comes without calibration, depth with one, or a number is not positive.
    """
    check_choice("kind", kind, ("depth", "disparity", "distance"))
    check_positive("scale", scale)
    check_choice("rotated_bits", rotated_bits, range(16))
    if kind == "depth":
        if focal_px is not None or baseline_m is not None or doffs_px:
            raise ValueError("focal_px, baseline_m and doffs_px belong to kind='disparity', got kind='depth'")
    elif kind == "distance":
        if baseline_m is not None or doffs_px:
            raise ValueError("baseline_m and doffs_px belong to kind='disparity', got kind='distance'")
        if focal_px is None:
            raise ValueError("distance along the ray gives depth by focal_px, the focal length in pixels, got None")
        check_positive("focal_px", focal_px, "pixels")
    elif focal_px is None or baseline_m is None:
        raise ValueError(
            "disparity without calibration cannot give metres: focal_px and baseline_m are needed, "
            f"got {focal_px} and {baseline_m}"
        )
    else:
        check_positive("focal_px", focal_px, "pixels")
        check_positive("baseline_m", baseline_m, "metres")
        if not BASELINES[0] <= baseline_m <= BASELINES[1]:
            factor = 0.001 if baseline_m > BASELINES[1] else 1000  # metres read as millimetres
            warn_once(
                None,
                "baseline_m",
                f"baseline_m is {baseline_m:g} m, and pairs of cameras are {BASELINES[0]:g} to {BASELINES[1]:g} m "
                f"apart: if it is in another unit, multiply it, perhaps by {factor:g}",
            )
        if not np.isfinite(doffs_px):
            raise ValueError(f"doffs_px must be finite pixels, got {doffs_px}")


def write_depth(path: str | os.PathLike[str], depth: Tensor, scale: float = 1.0, *, saturate: bool = False) -> None:
    """Write a depth map that :func:`read_depth` with the same ``scale`` reads back. The write is atomic.

    Args:
        path: ``.pfm`` and ``.npy`` (H, W) keep float32; ``.png`` keeps 16-bit multiples of ``scale`` and holds the
            scale as a text.
        depth: :math:`(1, H, W)` in metres, positive, may be infinite.
        scale: metres per stored unit; 0.001 lets a PNG hold 1 mm to 65.535 m.
        saturate: clip depths to the range of a PNG: its largest number then means *this far or farther*, infinity
            included, and its smallest, 1, *this near or nearer*. False: other depths raise ``ValueError``.

    Raises:
        TypeError: if the depth is not a floating-point tensor.
        ValueError: if its shape, a value, the scale or the suffix is not as above, a PNG cannot hold a value, or its
            scale is units per metre.
        FileNotFoundError: if the folder does not exist.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_depth(f"{folder}/depth.png", torch.tensor([[[0.25, float("inf")]]]), 0.001, saturate=True)
        ...     read_depth(f"{folder}/depth.png", 0.001).depth
        tensor([[[ 0.2500, 65.5350]]])
    """
    suffix = Path(path).suffix.lower()
    check_choice("the suffix of a depth file", suffix, (".pfm", ".png", ".npy"))
    check_positive("scale", scale, "metres")
    check_float_tensor("depth", depth, 3, "(1, H, W)")
    if depth.shape[0] != 1 or 0 in depth.shape:
        raise ValueError(f"depth must have shape (1, H, W), got {tuple(depth.shape)}")
    check_depth(depth)
    stored = depth[0].detach().double().cpu().numpy() / scale
    if suffix != ".png":
        write_bytes(path, (encode_pfm if suffix == ".pfm" else encode_npy)(stored.astype(np.float32)))
        return
    units = np.rint(stored)
    text = f"metres = value * {scale:g}"
    if saturate:
        np.clip(units, 1, 65535, out=units)
        text += f"; 65535 is {65535 * scale:g} m or farther"
    outside = (units < 1) | (units > 65535)
    if outside.any():
        bad = stored[outside][0] * scale
        raise ValueError(f"a 16-bit file with scale {scale} holds {scale} to {65535 * scale:.6g} m, got {bad:.6g}")
    check_depth_scale(scale, units)
    encoded = cv2.imencode(suffix, units.astype(np.uint16))[1].tobytes()
    write_bytes(path, with_text(encoded, {"depth_scale": f"{scale:g}", "Description": text}))


def ray_cosine(shape: tuple[int, ...], focal_px: float) -> NDArray[np.float64]:
    """Return the cosine of the angle between each pixel's ray and the optical axis, through the middle of the map.

    Args:
        shape: rows and columns.
        focal_px: focal length in pixels.

    Example:
        >>> ray_cosine((1, 3), 1.0).round(3)
        array([[0.707, 1.   , 0.707]])
    """
    y, x = (np.arange(length) - (length - 1) / 2 for length in shape)
    return focal_px / np.sqrt(focal_px**2 + x**2 + y[:, None] ** 2)


def _disparity_to_depth(disparity: NDArray[np.float64], focal_baseline: float) -> NDArray[np.float64]:
    """Return depth: infinite at zero disparity, NaN (unknown) at negative and 0 (unknown) at infinite disparity."""
    depth = np.full_like(disparity, np.nan)
    depth[disparity == 0] = np.inf
    with np.errstate(over="ignore"):
        np.divide(focal_baseline, disparity, out=depth, where=disparity > 0)
    return depth
