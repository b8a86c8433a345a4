"""Where PSFs that vary over the field are known, for operators in C: the struct ``field`` in field.h."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from kornia_tidy.kernels.operators import check


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


def of_axis(psfs: Tensor, places: Sequence[Tensor] | None) -> Tensor:
    """Return the PSFs of a node where there are places, and refuse wrong places."""
    if not places:
        return psfs
    check({}, None, **{"psfs over the field": (psfs, "I J D C P P")})
    if 0 in psfs.shape[:2]:
        raise ValueError(f"psfs over the field must have nodes, got shape {tuple(psfs.shape)}")
    check_places(places, psfs.shape[:2])
    return psfs[0, 0]


def check_places(places: Sequence[Tensor], nodes: Sequence[int]) -> None:
    """Refuse places with tensors that do not fit one another or the nodes. Looks at no value."""
    given = Places(*places)
    for axis, many in zip((given[:3], given[3:]), nodes, strict=True):
        edges, middles, weights = axis
        sizes = {"nodes": many, "edges": len(middles) + 1}
        check(sizes, torch.int64, **{"edges of tiles": (edges, "edges")})
        check(sizes, None, middles=(middles, "tiles"), weights=(weights, "tiles 2 nodes"))


def fields_of(
    places: Sequence[Tensor] | None, size: tuple[int, int], most: tuple[int, int], dtype: torch.dtype
) -> tuple[Any, ...]:
    """Return the fields of the struct: zeros, or edges in int64 and the rest in the data type of the PSFs.

    Args:
        places: :class:`Places`, checked, or none.
        size: rows and columns that the tiles must cover.
        most: rows and columns of a tile.
        dtype: of the PSFs.

    Raises:
        ValueError: if tiles do not cover the pixels or are too large.
    """
    if not places:
        return (0,) * 10
    given = Places(*places)
    down, across = given[:3], given[3:]
    for (edges, *_), pixels, largest in zip((down, across), size, most, strict=True):
        tiles = edges.diff()
        if edges[0] != 0 or edges[-1] != pixels or tiles.min() < 1 or tiles.max() > largest:
            raise ValueError(
                f"edges of tiles must ascend from 0 to {pixels} by {largest} at most, got {edges.tolist()!s:.80}"
            )
    sizes = down[2].shape[2], across[2].shape[2], len(down[1]), len(across[1])
    return *sizes, down[0], across[0], *(part[n].to(dtype) for n in (1, 2) for part in (down, across))
