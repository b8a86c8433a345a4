"""Grid of overlapping tiles of an image, and the part of each tile that is kept."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import NamedTuple

from torch import Tensor
from torch.nn import functional

from kornia_tidy.reconstruction.head import border_padding


class Span(NamedTuple):
    """A tile along one axis: its first pixel, and the kept pixels from ``kept`` to before ``end``."""

    start: int
    kept: int
    end: int


class TileGrid:
    r"""Overlapping tiles of an image.

    Positions are in the image padded as by :class:`~kornia_tidy.reconstruction.ReconstructionHead`, with sides P that
    are multiples of the stride. n tiles of side T that overlap by twice the margin R cover a side if

    .. math:: T \\geq \\frac{P + 2 R (n - 1)}{n}

    All tiles have one size, so that memory and choice of algorithms are the same for each.

    Args:
        size: rows and columns of the image.
        stride: spacing of the grid on which tiles begin and end, in pixels.
        overlap: pixels discarded at each cut; rounded up to the grid.

    Example:
        >>> grid = TileGrid((100, 250), stride=16, overlap=20)
        >>> grid.whole, grid.margin, grid.sides_within((112, 128))
        ((112, 256), 32, (112, 128))
        >>> [span for _, span in grid.tiles((112, 128))]
        [Span(start=0, kept=0, end=96), Span(start=64, kept=96, end=160), Span(start=128, kept=160, end=256)]
    """

    def __init__(self, size: tuple[int, int], stride: int, overlap: int) -> None:
        self.size, self.stride = size, stride
        self.margin = -(-overlap // stride) * stride
        (self.left, right, self.top, bottom), self.mode = border_padding(size, stride)
        self.whole = (size[0] + self.top + bottom, size[1] + self.left + right)

    def sides_within(self, wanted: tuple[int, int]) -> tuple[int, int]:
        """Return the sides of the largest tile that is not larger than wanted.

        Raises:
            ValueError: if it is smaller than the smallest tile.
        """
        sides = tuple(
            min(whole, side // self.stride * self.stride) for side, whole in zip(wanted, self.whole, strict=True)
        )
        if any(side < least for side, least in zip(sides, self.smallest_sides(), strict=True)):
            raise ValueError(
                f"a tile must have at least {' x '.join(map(str, self.smallest_sides()))} pixels for an overlap of "
                f"{self.margin} at each cut, got {wanted[0]} x {wanted[1]}"
            )
        return sides  # ty: ignore[invalid-explicit-return]

    def cheapest_sides(self, pixels: int) -> tuple[int, int] | None:
        """Return the sides of the tile with the least computation and at most ``pixels``, or None if no tile fits."""
        choices = []
        for rows, columns in product(self._counts(0), self._counts(1)):
            sides = self._side(0, rows), self._side(1, columns)
            if sides[0] * sides[1] <= pixels:
                choices.append((rows * columns * sides[0] * sides[1], sides))
        return min(choices)[1] if choices else None

    def smallest_sides(self) -> tuple[int, int]:
        """Return the sides of the smallest tile: a part of it is kept, and less of it is padding than image."""
        least = max(2 * self.margin, self.stride) + self.stride
        return min(least, self.whole[0]), min(least, self.whole[1])

    def tiles(self, sides: tuple[int, int]) -> list[tuple[Span, Span]]:
        """Return the tiles of given sides, row by row."""
        return list(product(self._spans(0, sides[0]), self._spans(1, sides[1])))

    def cut(self, image: Tensor, tile: tuple[Span, Span], sides: tuple[int, int]) -> Tensor:
        """Return a tile of an image (B, C, H, W), padded at the borders of the image."""
        (row, _, _), (column, _, _) = tile
        rows = self._inside(row, row + sides[0], self.top, self.size[0])
        columns = self._inside(column, column + sides[1], self.left, self.size[1])
        part = image[..., rows.start : rows.stop, columns.start : columns.stop]
        top, left = rows.start + self.top - row, columns.start + self.left - column
        bottom, right = sides[0] - top - len(rows), sides[1] - left - len(columns)
        return functional.pad(part, (left, right, top, bottom), self.mode) if top + bottom + left + right else part

    def keep(self, part: Tensor, whole: Tensor, tile: tuple[Span, Span]) -> None:
        """Copy the kept part of a tile's map into the map of the image, both (B, C, H, W)."""
        row, column = tile
        rows = self._inside(row.kept, row.end, self.top, self.size[0])
        columns = self._inside(column.kept, column.end, self.left, self.size[1])
        top, left = rows.start + self.top - row.start, columns.start + self.left - column.start
        kept = part[..., top : top + len(rows), left : left + len(columns)]
        whole[..., rows.start : rows.stop, columns.start : columns.stop] = kept

    def _counts(self, axis: int) -> Iterator[int]:
        """Yield the numbers of tiles along an axis, up to that of the smallest tile."""
        count, least = 1, self.smallest_sides()[axis]
        yield count
        while self._side(axis, count) > least:
            count += 1
            yield count

    def _side(self, axis: int, count: int) -> int:
        """Return the side of the tiles, if ``count`` of them cover an axis."""
        return -(-(self.whole[axis] + 2 * self.margin * (count - 1)) // (count * self.stride)) * self.stride

    def _spans(self, axis: int, side: int) -> list[Span]:
        last = self.whole[axis] - side
        if last == 0:
            return [Span(0, 0, side)]
        count = -(-last // (side - 2 * self.margin))
        starts = [last * i // (count * self.stride) * self.stride for i in range(count + 1)]
        edges = [0, *(start + self.margin for start in starts[1:]), self.whole[axis]]
        return [Span(start, edges[i], edges[i + 1]) for i, start in enumerate(starts)]

    @staticmethod
    def _inside(start: int, stop: int, before: int, size: int) -> range:
        """Return the range of image pixels between two positions of the padded image."""
        return range(max(0, start - before), min(size, stop - before))
