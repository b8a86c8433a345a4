"""Where PSFs that vary over the field are known, for operators in C: the struct ``field`` in field.h."""

from __future__ import annotations

import ctypes
from typing import NamedTuple

import torch
from torch import Tensor

PLACES = (
    *((name, ctypes.c_int64) for name in ("node_rows", "node_columns", "down", "across")),
    *((name, ctypes.c_void_p) for name in ("row_edges", "column_edges", "row_middles", "column_middles")),
    *((name, ctypes.c_void_p) for name in ("row_weights", "column_weights")),
)  # the struct


class Places(NamedTuple):
    r"""Tiles of a picture with PSFs that are known at nodes over the field, along rows and along columns.

    .. math:: h(y, x) = \sum_{ij} \left( a_i b_j + (y - y_0) \, a'_i b_j + (x - x_0) \, a_i b'_j \right) h_{ij}

    Args:
        row_edges: first row of each row of tiles and the end of the last, (R + 1,) int64 on a processor.
        row_middles: :math:`y_0` of each row of tiles, (R,) float64.
        row_weights: :math:`a_i` and :math:`a'_i` of each row of tiles, (R, 2, I) float64.
        column_edges: the same along columns.
        column_middles: as above.
        column_weights: :math:`b_j` and :math:`b'_j`, (S, 2, J).
    """

    row_edges: Tensor
    row_middles: Tensor
    row_weights: Tensor
    column_edges: Tensor
    column_middles: Tensor
    column_weights: Tensor

    def of_pixels(self) -> Tensor:
        """Return the weight of each node at each pixel, (I J, H, W) float64.

        Example:
            >>> one = torch.tensor([0, 1]), torch.zeros(1), torch.tensor([[[1.0], [0.0]]])
            >>> two = torch.tensor([0, 3]), torch.ones(1), torch.tensor([[[0.5, 0.5], [-0.25, 0.25]]])
            >>> Places(*one, *two).of_pixels().flatten(1)
            tensor([[0.7500, 0.5000, 0.2500],
                    [0.2500, 0.5000, 0.7500]])
        """
        values, slopes = [], []
        for edges, middles, weights in (self[:3], self[3:]):
            own, pixels = weights.repeat_interleave(edges.diff(), 0), torch.arange(int(edges[-1]))
            values.append(own[:, 0].T)
            slopes.append((own[:, 1] * (pixels - middles.repeat_interleave(edges.diff()))[:, None]).T)
        (a, b), (y, x) = values, slopes
        return ((a + y)[:, None, :, None] * b[:, None] + a[:, None, :, None] * x[:, None]).flatten(0, 1)


def check_places(places: list[Tensor], nodes: tuple[int, ...]) -> None:
    """Refuse places with tensors that do not fit one another or the nodes. Looks at no value."""
    given = Places(*places)
    for axis, many in zip((given[:3], given[3:]), nodes, strict=True):
        edges, middles, weights = axis
        tiles = tuple(middles.shape)
        if (tuple(edges.shape), tuple(weights.shape)) != ((len(middles) + 1,), (*tiles, 2, many)):
            shapes = ", ".join(str(tuple(x.shape)) for x in axis)
            raise ValueError(
                f"places must be n + 1 edges, n middles and (n, 2, {many}) weights of nodes, got shapes {shapes}"
            )


def of_axis(psfs: Tensor, places: list[Tensor]) -> Tensor:
    """Return the PSFs of a node where there are places, and refuse wrong places."""
    if not places:
        return psfs
    if psfs.ndim != 6 or 0 in psfs.shape[:2]:
        raise ValueError(f"psfs over the field must have shape (I, J, D, C, P, P), got {tuple(psfs.shape)}")
    check_places(places, psfs.shape[:2])
    return psfs[0, 0]


def parameters_of(
    places: list[Tensor], size: tuple[int, int], most: tuple[int, int], dtype: torch.dtype
) -> tuple[dict[str, int], dict[str, Tensor]]:
    """Return the numbers and the tensors of the struct, edges in int64 and the rest in the data type of the PSFs.

    Args:
        places: :class:`Places`, checked.
        size: rows and columns that the tiles must cover.
        most: rows and columns of a tile.
        dtype: of the PSFs.

    Raises:
        TypeError: if edges are not int64.
        ValueError: if tiles do not cover the pixels or are too large.
    """
    given = Places(*places)
    for edges, pixels, largest in zip((given.row_edges, given.column_edges), size, most, strict=True):
        _check_edges(edges, pixels, largest)
    numbers = {"node_rows": given.row_weights.shape[-1], "node_columns": given.column_weights.shape[-1]}
    numbers |= {"down": len(given.row_middles), "across": len(given.column_middles)}
    return numbers, {name: x if name.endswith("edges") else x.to(dtype) for name, x in given._asdict().items()}


def _check_edges(edges: Tensor, pixels: int, largest: int) -> None:
    """Refuse tiles that do not cover the pixels of an axis or do not fit into windows."""
    if edges.dtype != torch.int64:
        raise TypeError(f"edges of tiles must be int64, got {edges.dtype}")
    tiles = edges.diff()
    if edges[0] != 0 or edges[-1] != pixels or tiles.min() < 1 or tiles.max() > largest:
        raise ValueError(
            f"edges of tiles must ascend from 0 to {pixels} by {largest} at most, got {edges.tolist()!s:.80}"
        )
