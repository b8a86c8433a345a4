"""Colour filter arrays: the tile of colours that repeats over a sensor."""

from __future__ import annotations

import math
from collections.abc import Sequence

from torch import Tensor

from kornia_tidy.checks import check_choice

Tile = tuple[tuple[int, ...], ...]  # index of a channel at each place, by rows

PATTERN_COLORS = {"RGB": "RGB", "CGMY": "GMCY"}  # LibRaw's order of the colours, by the letters of a filter array


def filter_tile(letters: str) -> tuple[Tile, str]:
    """Return the tile of a filter array as channel indices, and the names of the channels.

    Args:
        letters: by rows: 4 for a 2x2 tile, 36 for 6x6.

    Convention:
        As in LibRaw, the green of blue's row is a fourth channel in a 2x2 tile of R, G and B.

    Example:
        >>> filter_tile("GRBG")
        (((1, 0), (2, 3)), 'RGBG')
    """
    side = math.isqrt(len(letters))
    kinds = "".join(sorted(set(letters)))
    kinds = "RGB" if kinds == "BGR" else kinds
    if side not in {2, 6} or side * side != len(letters):
        raise ValueError(f"a filter array's tile has 4 or 36 letters, got {letters!r}")
    check_choice("the letters of a filter array, sorted,", kinds, tuple(PATTERN_COLORS))
    rows = [letters[i : i + side] for i in range(0, len(letters), side)]
    return indexed_tile(rows, PATTERN_COLORS[kinds])


def indexed_tile(rows: Sequence[str], planes: str) -> tuple[Tile, str]:
    """Return a tile of letters as channel indices, and the names of the channels, by the convention of filter_tile.

    Args:
        rows: letters of the tile.
        planes: the different letters in their order.

    Example:
        >>> indexed_tile(["RB", "WG"], "RGBW")
        (((0, 2), (3, 1)), 'RGBW')
    """
    second = len(rows) == 2 and planes == "RGB" and any("B" in row and "G" in row for row in rows)
    tile = tuple(tuple(3 if second and c == "G" and "B" in row else planes.index(c) for c in row) for row in rows)
    return tile, planes + "G" * second


def is_xtrans(letters: str) -> bool:
    """Return whether the letters of a tile are those of Fujifilm's X-Trans array, with 20 green pixels of 36.

    Example:
        >>> is_xtrans("GGRGGBGGBGGRBRGRBGGGBGGRGGRGGBRBGBRG"), is_xtrans("RGGB")
        (True, False)
    """
    return [letters.count(color) for color in "RGB"] == [8, 20, 8]


def tile_planes(mosaic: Tensor, tile: tuple[int, int]) -> Tensor:
    """Split a mosaic (C, H, W) into planes by place of the tile, (C * rows * columns, H // rows, W // columns).

    Example:
        >>> import torch
        >>> tile_planes(torch.arange(8).view(1, 2, 4), (2, 2)).tolist()
        [[[0, 2]], [[1, 3]], [[4, 6]], [[5, 7]]]
    """
    rows, columns = tile
    channels, height, width = mosaic.shape[0], mosaic.shape[1] // rows, mosaic.shape[2] // columns
    whole = mosaic[:, : height * rows, : width * columns]
    places = whole.reshape(channels, height, rows, width, columns).permute(0, 2, 4, 1, 3)
    return places.reshape(channels * rows * columns, height, width)


def tiled(tile: Tensor, height: int, width: int) -> Tensor:
    """Repeat a tile (rows, columns) over (height, width) pixels.

    Example:
        >>> import torch
        >>> tiled(torch.tensor([[0, 1], [3, 2]]), 2, 5)
        tensor([[0, 1, 0, 1, 0],
                [3, 2, 3, 2, 3]])
    """
    rows, columns = tile.shape
    return tile.repeat(-(-height // rows), -(-width // columns))[:height, :width]
