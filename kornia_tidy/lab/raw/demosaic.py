"""Demosaicing: interpolation of all colours at every pixel from the one colour sampled there."""

from __future__ import annotations

import io
import itertools

import numpy as np
import torch
from torch import Tensor

from kornia_tidy.checks import check_choice, check_float_tensor
from kornia_tidy.lab.raw.color import srgb_from_xyz
from kornia_tidy.lab.raw.dng_fields import D65, SHORT, SRATIONAL, Field, dng_bytes
from kornia_tidy.lab.raw.filter_array import Tile, is_xtrans
from kornia_tidy.lab.raw.quantised_demosaicing import ROWS_AT_ONCE, demosaic_quantised
from kornia_tidy.search_path import import_installed

BAYER = ("RGGB", "GRBG", "BGGR", "GBRG")
# For other names LibRaw silently falls back on VNG for four colours and on Markesteijn's three passes for X-Trans.
LIBRAW = {
    "Bayer": ("linear", "vng", "ppg", "ahd", "dcb", "dht"),
    "four-colour": ("linear", "vng"),
    "X-Trans": ("markesteijn",),
}
LARGEST_FACTOR = 100.0  # of the matrix from sRGB to a camera: larger ones are not plausible and do not fit a DNG field
# Only methods with a bounded reach are computed in bands. DCB and DHT iterate over the picture, and Markesteijn's
# method treats its squares of 512 pixels differently.
LIBRAW_LOCAL, LIBRAW_REACH = ("linear", "vng", "ppg", "ahd"), 8  # rows: 5 bilinear ones at AHD's border, and 3 more
LIBRAW_SMALLEST = {"Bayer": 22, "four-colour": 22, "X-Trans": 512}  # least shorter side in pixels

METHODS = (
    "bilinear",
    "half",
    *dict.fromkeys(f"libraw_{name}" for names in LIBRAW.values() for name in names),
)


def demosaic(
    mosaic: Tensor, pattern: Tile, colors: str, method: str = "bilinear", to_srgb: Tensor | None = None
) -> Tensor:
    """Demosaic: interpolate all colours at every pixel of a mosaic.

    Args:
        mosaic: (..., 1, H, W), linear; white-balanced, for the methods that follow edges.
        pattern: index into ``colors`` at each place of the repeating tile, from the upper left corner.
        colors: names of the channels by index; a letter that comes twice is one colour. Both as
            :func:`~kornia_tidy.lab.raw.filter_array.filter_tile` returns them.
        method: the algorithm, named after the library that computes it.

            * ``"bilinear"``: for any tile; differentiable, on any device, not quantised. Samples are kept; missing
              values are the mean of the same colour nearby, weighted by a tent.
            * ``"half"``: no interpolation. Each 2x2 tile (3x3 for X-Trans) becomes one pixel, the mean of each colour.
            * ``"libraw_linear"``, ``"libraw_vng"``: Bayer and four-colour; ``"libraw_ppg"``, ``"libraw_ahd"``,
              ``"libraw_dcb"``, ``"libraw_dht"``: Bayer; ``"libraw_markesteijn"``: X-Trans.
        to_srgb: matrix from the balanced colours to linear sRGB, (3, C), by which the result is multiplied; quantised
            methods do it in the pass that restores real values. ``"libraw_ahd"`` and ``"libraw_markesteijn"`` compare
            colours in CIELAB by it. None: the colours of the array are returned, and count as those of sRGB.

    Returns:
        (..., C, H, W) with C different colours, in the order of ``colors``, or (..., 3, H, W) in linear sRGB;
        ``"half"``: (..., H // 2, W // 2).

    Raises:
        ValueError: if the method is unknown or does not support this tile or size, if the mosaic has another shape, or
            if it is not finite (LibRaw).

    Convention:
        - Nothing is clipped: values below 0 and above 1 are interpolated like others.
        - LibRaw computes with integers. The range of the mosaic, extended to include 0 and 1, is quantised to 65535
          steps, of 1.5e-5 for values in [0, 1]. These methods have no gradient.

    Source: VNG: Chang, Cheung and Pang 1999. AHD: Hirakawa and Parks 2005. PPG: Lin 2003. DCB: Góźdź. X-Trans:
        Markesteijn, in dcraw.

    Example:
        >>> mosaic = torch.tensor([[[0.9, 0.5, 0.9, 0.5], [0.5, 0.1, 0.5, 0.1]]])
        >>> rgb = demosaic(mosaic, ((0, 1), (3, 2)), "RGBG")
        >>> rgb[:, 1, 2]
        tensor([0.9000, 0.5000, 0.1000])
        >>> matrix = torch.tensor([[1.0, 0, 0], [0, 0.5, 0], [0, 0.5, 0.5]])
        >>> demosaic(mosaic, ((0, 1), (3, 2)), "RGBG", to_srgb=matrix)[:, 1, 2]
        tensor([0.9000, 0.2500, 0.3000])
    """
    check_choice("method of demosaicing", method, METHODS)
    check_float_tensor("mosaic", mosaic.reshape(-1, *mosaic.shape[-2:]), 3, "(..., 1, H, W)")
    if mosaic.ndim < 3 or mosaic.shape[-3] != 1:
        raise ValueError(f"mosaic must have shape (..., 1, H, W), got {tuple(mosaic.shape)}")
    names = "".join(dict.fromkeys(colors))
    tile: Tile = tuple(tuple(names.index(colors[index]) for index in row) for row in pattern)
    height, width = mosaic.shape[-2:]
    if height < len(tile) or width < len(tile[0]):
        raise ValueError(f"mosaic must hold one tile of {len(tile)} x {len(tile[0])} px, got {height} x {width}")
    flat = mosaic.reshape(-1, height, width)
    letters = "".join(names[index] for row in tile for index in row)
    if method in {"bilinear", "half"}:
        image = (bilinear if method == "bilinear" else binned)(flat, tile)
        image = image if to_srgb is None else mixed(image, to_srgb)
    else:
        image = _libraw(flat, letters, names, method.removeprefix("libraw_"), to_srgb)
    return image.reshape(*mosaic.shape[:-3], *image.shape[-3:])


def mixed(image: Tensor, matrix: Tensor) -> Tensor:
    """Multiply the colours of an image (..., colours, H, W) by a matrix (3, colours), in place for three colours."""
    result = image if image.shape[-3] == 3 else image.new_empty(*image.shape[:-3], 3, *image.shape[-2:])
    for top in range(0, image.shape[-2], ROWS_AT_ONCE):
        rows = slice(top, top + ROWS_AT_ONCE)
        result[..., rows, :] = torch.einsum("ij,...jhw->...ihw", matrix.to(image), image[..., rows, :])
    return result


def bilinear(mosaic: Tensor, tile: Tile) -> Tensor:
    """Interpolate mosaics (N, H, W) to (N, C, H, W) by normalised convolution with a tent.

    The reach of the tent is the side of the smallest square that contains every colour at any position: two pixels for
    Bayer, where this is bilinear interpolation, and three for X-Trans. At the border the nearest tile is repeated.

    Source: Knutsson and Westin, Normalized and differential convolution, CVPR 1993.
    """
    rows, columns = len(tile), len(tile[0])
    height, width = mosaic.shape[-2:]
    reach = next(side for side in range(1, rows + 1) if _holds_all(tile, side, 1))
    values = mosaic if mosaic.dtype == torch.float64 else mosaic.float()
    values = values[:, _beyond(height, rows, reach - 1)][:, :, _beyond(width, columns, reach - 1)]
    image = values.new_zeros(len(mosaic), 1 + max(map(max, tile)), height, width)
    for y, x, color in itertools.product(range(rows), range(columns), range(image.shape[1])):
        there = image[:, color, y::rows, x::columns]
        for dy, dx, weight in _tent(tile, y, x, color, reach):
            samples = values[:, y + dy + reach - 1 :: rows, x + dx + reach - 1 :: columns]
            there.add_(samples[:, : there.shape[1], : there.shape[2]], alpha=weight)
    return image.to(mosaic.dtype)


def _tent(tile: Tile, y: int, x: int, color: int, reach: int) -> list[tuple[int, int, float]]:
    """Return offsets and weights of the samples that give a colour at a place of the tile; (0, 0) if sampled there."""
    if tile[y][x] == color:
        return [(0, 0, 1.0)]
    steps = range(1 - reach, reach)
    samples = [
        (dy, dx, (reach - abs(dy)) * (reach - abs(dx)))
        for dy, dx in itertools.product(steps, steps)
        if tile[(y + dy) % len(tile)][(x + dx) % len(tile[0])] == color
    ]
    total = sum(weight for _, _, weight in samples)
    return [(dy, dx, weight / total) for dy, dx, weight in samples]


def _beyond(length: int, period: int, margin: int) -> Tensor:
    """Return pixel indices with a margin at both ends, in which the nearest tile is repeated."""
    index = torch.arange(-margin, length + margin)
    last = (length - 1 - index.clamp(min=length - 1)).div(period, rounding_mode="floor") * period
    first = (-index.clamp(max=0)).add(period - 1).div(period, rounding_mode="floor") * period
    return index + first + last


def binned(mosaic: Tensor, tile: Tile) -> Tensor:
    """Bin each colour over squares of s x s pixels that contain all colours, (N, C, H // s, W // s).

    s is 2 for a 2x2 tile and 3 for X-Trans. Pixels beyond the last whole square are left out.
    """
    rows, columns = len(tile), len(tile[0])
    side = next(side for side in range(1, rows + 1) if rows % side == 0 and _holds_all(tile, side, side))
    height, width = mosaic.shape[-2] // side, mosaic.shape[-1] // side
    image = mosaic.new_zeros(len(mosaic), 1 + max(map(max, tile)), height, width)
    for top, left in itertools.product(range(0, rows, side), range(0, columns, side)):
        squares = image[:, :, top // side :: rows // side, left // side :: columns // side]
        places = list(itertools.product(range(top, top + side), range(left, left + side)))
        for y, x in places:
            samples = mosaic[:, y::rows, x::columns][:, : squares.shape[2], : squares.shape[3]]
            count = sum(tile[j][i] == tile[y][x] for j, i in places)
            squares[:, tile[y][x]] += samples / count
    return image


def _holds_all(tile: Tile, side: int, step: int) -> bool:
    """Return whether squares of this side contain every colour at all positions that are multiples of ``step``."""
    number = {index for row in tile for index in row}
    places = range(0, len(tile), step)
    return all(
        {tile[(y + dy) % len(tile)][(x + dx) % len(tile)] for dy in range(side) for dx in range(side)} == number
        for y in places
        for x in places
    )


def _libraw(mosaic: Tensor, letters: str, colors: str, name: str, to_srgb: Tensor | None) -> Tensor:
    rawpy = import_installed("rawpy")  # a C++ library, loaded only when needed

    four = len(colors) == len(letters) == 4
    kind = "Bayer" if letters in BAYER else "four-colour" if four else "X-Trans" if is_xtrans(letters) else "other"
    if kind == "other":
        raise ValueError(f"LibRaw demosaics Bayer, four-colour and X-Trans arrays, not {letters}: choose 'bilinear'")
    check_choice(f"LibRaw's demosaicing of a {kind} array", name, LIBRAW[kind])
    side = 6 if kind == "X-Trans" else 2
    lacking = LIBRAW_SMALLEST[kind] - min(mosaic.shape[-2:])
    tiles = max(-(-lacking // (2 * side)), int(kind == "X-Trans"), 0)  # LibRaw leaves the corner of X-Trans black
    margin = tiles * side
    height, width = mosaic.shape[-2:]
    algorithm = rawpy.DemosaicAlgorithm["AHD" if name == "markesteijn" else name.upper()]
    fields = [] if kind == "four-colour" else _matrix_fields(to_srgb)

    def postprocess(counts: np.ndarray) -> np.ndarray:
        with rawpy.imread(io.BytesIO(dng_bytes(counts[..., None], letters, colors, 65535, fields))) as raw:
            return raw.postprocess(
                demosaic_algorithm=algorithm,
                output_color=rawpy.ColorSpace.raw,
                output_bps=16,
                gamma=(1, 1),
                user_wb=[1.0, 1.0, 1.0, 1.0],
                no_auto_bright=True,
                adjust_maximum_thr=0.0,
                user_flip=0,
            )

    wide = mosaic[:, _beyond(height, side, margin)][:, :, _beyond(width, side, margin)] if margin > 0 else mosaic
    matrix = torch.eye(len(colors)) if to_srgb is None else to_srgb
    image = demosaic_quantised(wide, postprocess, matrix, LIBRAW_REACH if name in LIBRAW_LOCAL else None)
    return image[..., margin : margin + height, margin : margin + width] if margin > 0 else image


def _matrix_fields(to_srgb: Tensor | None) -> list[Field]:
    """Return the DNG colour matrix fields; the primaries are sRGB's for an unknown or almost singular matrix."""
    matrix = torch.eye(3, dtype=torch.float64) if to_srgb is None else to_srgb.detach().double().cpu()
    inverse = matrix.pinverse()
    if float(inverse.abs().max()) > LARGEST_FACTOR:
        inverse = torch.eye(3, dtype=torch.float64)
    from_xyz = inverse @ srgb_from_xyz()
    return [(50721, SRATIONAL, from_xyz.flatten().tolist()), (50778, SHORT, [D65])]
