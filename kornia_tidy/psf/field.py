r"""Where over a picture PSFs are known, and how they are found between these places.

Nodes stand at the Chebyshev points of the picture's rows and columns, corners included, and PSFs between them follow a
polynomial along either axis:

.. math:: h(y, x) = \sum_{ij} \ell_i(y)\, \ell_j(x)\, h_{ij}
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kornia_tidy.checks import described
from kornia_tidy.optics.units import warn_once

ROUNDING, NO_DIFFERENCE = 1e-6, 0.05  # px; places between the two are no places of a picture, but may be metres


@dataclass(frozen=True)
class Field:
    """Nodes over a picture, in sensor pixels.

    Args:
        size: rows and columns of the picture.
        nodes: number of nodes along its height and along its width.
        center: of the picture, y and x from the lens's axis.
        origin: row and column in the picture of the first pixel of the light that is rendered: negative where a border
            was added, and above zero in a lower strip.
        cell: side in pixels of the largest cells in which PSFs are taken to first order about the middle.
        still: side in pixels of the largest cells in which PSFs may be taken as in the middle.

    Convention:
        - The middle of the picture is at ``(size - 1) / 2``. PSFs beyond the picture, as of a border, are those of the
          nearest pixel in it; in a cell with its middle in the picture they are continued to first order.

    Example:
        >>> field = Field((101, 201), (2, 3))
        >>> field.points
        ((-50.0, -100.0), (-50.0, 0.0), (-50.0, 100.0), (50.0, -100.0), (50.0, 0.0), (50.0, 100.0))
        >>> field.along(1, torch.tensor([50.0]))[0].round(decimals=3)
        tensor([[ 0.3750,  0.7500, -0.1250]], dtype=torch.float64)
    """

    size: tuple[int, int]
    nodes: tuple[int, int]
    center: tuple[float, float] = (0.0, 0.0)
    origin: tuple[int, int] = (0, 0)
    cell: int = 64
    still: int = 0

    @property
    def points(self) -> tuple[tuple[float, float], ...]:
        """Places of the nodes from the lens's axis, y and x, row by row."""
        rows, columns = (
            [self.center[axis] + x * (self.size[axis] - 1) / 2 for x in chebyshev_points(self.nodes[axis])]
            for axis in (0, 1)
        )
        return tuple((y, x) for y in rows for x in columns)

    def moved(self, rows: int, columns: int) -> Field:
        """Return the field for light that begins so many rows and columns further."""
        return replace(self, origin=(self.origin[0] + rows, self.origin[1] + columns))

    def along(self, axis: int, pixels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the weights of the nodes along an axis at some pixels, with first and second derivatives for a pixel.

        Args:
            axis: 0 for rows, 1 for columns.
            pixels: (n,) row or column in the picture.

        Returns:
            (n, nodes) each, float64; weights sum to one, derivatives to zero, which they are beyond the picture.
        """
        half = (self.size[axis] - 1) / 2
        places = (pixels.double() - half) / max(half, 0.5)
        weights, slopes, bends = lagrange(self.nodes[axis], places.clamp(-1, 1))
        inside = (places.abs() <= 1).double()[:, None] / max(half, 0.5)
        return weights, slopes * inside, bends * inside**2

    def tiles(self, axis: int, first: int, pixels: int, most: int, beyond: int = 0) -> tuple[Tensor, Tensor, Tensor]:
        r"""Return the tiles along an axis of a part of the picture: as large as possible, and alike in any part.

        A tile of n pixels takes for its middle :math:`h + h'' (n^2 - 1) / 24`, so that its first order is right on
        average. Slopes are zero in tiles in which PSFs may be taken as in the middle.

        Args:
            axis: 0 for rows, 1 for columns.
            first: row or column of the picture at which the part begins.
            pixels: of the part.
            most: pixels of a tile.
            beyond: pixels of a border on either side of the picture, which tiles also cover.

        Returns:
            Where in the part tiles begin, and its end, (n + 1,) int64; the middles of the picture's tiles, counted from
            the part's first pixel, (n,) float64; the nodes' weights of the first order there, (n, 2, nodes).

        Example:
            >>> edges, middles, weights = Field((1, 90), (1, 2)).tiles(1, 20, 60, 40)
            >>> edges.tolist(), middles.tolist(), weights[:, 0, 1].round(decimals=2).tolist()
            ([0, 10, 40, 60], [-5.5, 24.5, 54.5], [0.16, 0.5, 0.84])
        """
        whole = self.size[axis] + 2 * beyond
        side = -(-whole // -(-whole // most))
        begin, end = ((at + beyond) // side for at in (first, first + pixels - 1))
        starts = torch.arange(begin, end + 1) * side - beyond
        middles = starts.double() + (side - 1) / 2
        edges = torch.cat([(starts - first).clamp(min=0), torch.tensor([pixels])])
        weights, slopes, bends = self.along(axis, middles)
        orders = weights + bends * (side**2 - 1) / 24, slopes * (side > self.still)
        return edges, middles - first, torch.stack(orders, 1)


def check_center(center: Any) -> tuple[float, float]:
    """Return where the middle of a picture lies, y and x in sensor pixels from the lens's axis, or raise an error.

    A place within a twentieth of a pixel of the axis, and not on it, gets a warning: it may be in metres.

    Example:
        >>> check_center([3, 4])
        (3.0, 4.0)
    """
    try:
        y, x = (float(part) for part in center)
    except (TypeError, ValueError, RuntimeError):
        raise TypeError(
            f"field_center must be two numbers, y and x in sensor pixels, got {described(center)}"
        ) from None
    if not (math.isfinite(y) and math.isfinite(x)):
        raise ValueError(f"field_center must be finite, got {(y, x)}")
    if ROUNDING < max(abs(y), abs(x)) < NO_DIFFERENCE:
        said = f"field_center is in sensor pixels, and {(y, x)} is the axis: divide metres by the pixel pitch"
        warn_once(None, "field_center", said, stacklevel=4)
    return y, x


def check_centers(centers: Any, count: int) -> tuple[tuple[float, float], ...]:
    """Return where the middles of a batch's pictures lie: one place for all of them, or one for each.

    Args:
        centers: (2,), or (B, 2) in any form.
        count: B.

    Raises:
        TypeError: if they are not numbers.
        ValueError: if they are not finite, or of another number.

    Example:
        >>> check_centers(torch.tensor([[3.0, 4.0], [0.0, 1.0]]), 2)
        ((3.0, 4.0), (0.0, 1.0))
    """
    rows = centers.tolist() if hasattr(centers, "tolist") else centers
    if not isinstance(rows, (tuple, list)) or not all(isinstance(row, (tuple, list)) for row in rows) or not rows:
        return (check_center(rows),)
    if len(rows) not in (1, count):
        raise ValueError(f"field_center must be one place, or one for each of {count} images, got {len(rows)}")
    return tuple(check_center(row) for row in rows)


def chebyshev_points(count: int) -> list[float]:
    """Return the extrema of a Chebyshev polynomial, from -1 to 1; the middle for a single one.

    Example:
        >>> [round(x, 3) for x in chebyshev_points(4)]
        [-1.0, -0.5, 0.5, 1.0]
    """
    return [math.sin(math.pi * (2 * i - count + 1) / (2 * max(count - 1, 1))) for i in range(count)]


def lagrange(count: int, places: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the Lagrange polynomials of the Chebyshev points and two derivatives, (n, count) float64 each.

    Args:
        count: of the points.
        places: (n,) from -1 to 1.

    Example:
        >>> values, slopes, bends = lagrange(2, torch.tensor([0.5]))
        >>> values.tolist(), slopes.tolist(), bends.tolist()
        ([[0.25, 0.75]], [[-0.5, 0.5]], [[0.0, 0.0]])
    """
    value, first, second = _series(count)
    at = torch.from_numpy(np.polynomial.chebyshev.chebvander(places.double().tolist(), max(count - 1, 1)))
    return at[:, :count] @ value, at[:, : len(first)] @ first, at[:, : len(second)] @ second


@lru_cache(maxsize=32)
def _series(count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return the Chebyshev series of the Lagrange polynomials and of two derivatives, a column for each."""
    with torch.inference_mode(False):
        polynomials = np.polynomial.chebyshev
        series = np.linalg.inv(polynomials.chebvander(chebyshev_points(count), count - 1))
        value, first, second = (torch.from_numpy(polynomials.chebder(series, n, axis=0)) for n in range(3))
        return value, first, second
