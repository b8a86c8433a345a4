"""Tiles: a plane is cut into blocks that each meet only the layers they contain.

Seen through PSFs of P pixels, a tile needs a window of P - 1 more pixels a side, which is transformed. A block is
``across`` tiles side by side. Two make one complex plane: the left window is its real and the right one its imaginary
part, so that one transform serves both. A pair is a block and a layer in it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise, product
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from kornia_tidy.render.scene import Labels

Extent = tuple[tuple[int, int], ...]  # first and last image, row and column of blocks


@dataclass(frozen=True)
class Grid:
    """Blocks over a batch of planes, numbered image by image, row by row. The last ones may reach beyond the plane.

    Args:
        batch: images.
        shape: height and width of the rendered plane in pixels.
        lost: rows and columns P - 1 of a window that are no tile.
        size: height and width of a window in samples.
        across: tiles that stand side by side in a block.
        windowed: a layer counts wherever it lies in the windows, not only in the tiles.

    Example:
        >>> grid = Grid(batch=1, shape=(100, 150), lost=22, size=(64, 64), across=2)
        >>> grid.tile, grid.rows, grid.columns, grid.blocks
        ((42, 42), 3, 2, 6)
    """

    batch: int
    shape: tuple[int, int]
    lost: int
    size: tuple[int, int]
    across: int = 1
    windowed: bool = False

    @property
    def tile(self) -> tuple[int, int]:
        """Height and width of a tile in pixels."""
        return self.size[0] - self.lost, self.size[1] - self.lost

    @property
    def rows(self) -> int:
        """Blocks from top to bottom."""
        return -(-self.shape[0] // self.tile[0])

    @property
    def columns(self) -> int:
        """Blocks from left to right."""
        return -(-self.shape[1] // (self.across * self.tile[1]))

    @property
    def blocks(self) -> int:
        """Blocks of all images."""
        return self.batch * self.rows * self.columns

    def number(self, images: Tensor, y: Tensor, x: Tensor) -> Tensor:
        """Return the block of pixels, (images, y, x), by their indices along each axis."""
        row, column = y // self.tile[0], x // (self.across * self.tile[1])
        return (images[:, None, None] * self.rows + row[:, None]) * self.columns + column

    def present(self, labels: Labels, layers: int, step: int = 1) -> Tensor:
        """Return (blocks, layers) bool: which of the layers a block contains. Labels are of every ``step``-th pixel."""
        device, reach = labels.layer_index.device, self.lost if self.windowed else 0
        images, (height, width) = torch.arange(self.batch, device=device), self.shape
        y, x = (torch.arange(0, side + reach, step, device=device) for side in self.shape)
        present = torch.zeros(self.blocks * layers, dtype=torch.bool, device=device)
        # Windows reach into the next block only: a pixel counts for its own block and for the one before.
        for up, left in product({0, reach}, repeat=2):
            rows, columns = (y - up).clamp_(0, height - 1), (x - left).clamp_(0, width - 1)
            for first in range(0, len(y), 64):  # in a processor's cache
                part = slice(first, first + 64)
                keys = self.number(images, rows[part], columns).mul_(layers)
                for layer in labels.terms(slice(None), part):
                    present.index_fill_(0, (keys + layer).flatten(), True)
        return present.view(-1, layers)

    def first(self, extent: Extent) -> tuple[int, int]:
        """Return the first block of an extent whose blocks follow one another, and the one after its last."""
        (image, last_image), (row, last_row), (column, last_column) = extent
        last = ((last_image - 1) * self.rows + last_row - 1) * self.columns + last_column
        return (image * self.rows + row) * self.columns + column, last


class Chunk(NamedTuple):
    """Blocks that are worked on together: some images, or some rows of one image, or a part of one row.

    Args:
        extent: images, rows and columns of blocks.
        pixels: images, rows and columns of pixels, an index into (B, H, W).
        first: number of its first pair.
        block: (K,) block of each pair, counted from the chunk's first.
        layer: (K,) layer of each pair, as an index into :attr:`Plan.layers`.
        counts: pairs of each block; of all blocks together where they have the same layers.
        runs: blocks with the same layers, which follow one another: blocks, pairs and layers. One product serves them.
    """

    extent: tuple[int, ...]
    pixels: tuple[slice, ...]
    first: int
    block: Tensor
    layer: Tensor
    counts: list[int]
    runs: list[tuple[slice, slice, slice]]


class Plan(NamedTuple):
    """The pairs of a scene, numbered by block and then by layer, in chunks.

    Args:
        grid: the blocks.
        layers: (D',) the layers that are worked on.
        number: (blocks, D) number of each pair; of no meaning where block and layer are none.
        chunks: the blocks in order.
    """

    grid: Grid
    layers: Tensor
    number: Tensor
    chunks: list[Chunk]


def plan_pairs(grid: Grid, labels: Labels, layers: int, limit: int) -> Plan:
    """List the pairs of a block and a layer, and group the blocks into chunks.

    On a processor they are those of the scene, elsewhere all: no value is looked at.

    Args:
        grid: the blocks.
        labels: the layers of each pixel.
        layers: number of layers D.
        limit: pairs of a chunk, unless a block has more.
    """
    device, blocks = labels.layer_index.device, grid.blocks
    if device.type == "cpu":
        present = grid.present(labels, layers)
        used = present.any(0).nonzero()[:, 0]
        number = present.flatten().cumsum(0).sub_(1).view_as(present)
        block, layer = present[:, used].nonzero().unbind(1)
        ends, known = [0, *present.sum(1).cumsum(0).tolist()], layer.tolist()
    else:
        used, known = torch.arange(layers, device=device), None
        number = torch.arange(blocks * layers, device=device).view(blocks, layers)
        block, layer = number.flatten() // layers, number.flatten() % layers
        ends = list(range(0, blocks * layers + 1, layers))
    chunks = []
    for extent in _halved(grid, ends, limit):
        first, last = grid.first(extent)
        pairs, tiles = slice(ends[first], ends[last]), (1, grid.tile[0], grid.across * grid.tile[1])
        pixels = tuple(
            slice(start * tile, min(stop * tile, side))
            for (start, stop), tile, side in zip(extent, tiles, (grid.batch, *grid.shape), strict=True)
        )
        if known is None:
            counts = [ends[last] - ends[first]]
            runs = [(slice(0, last - first), slice(0, counts[0]), slice(0, layers))]
        else:
            counts = [stop - start for start, stop in pairwise(ends[first : last + 1])]
            runs = list(_runs(known[pairs], counts))
        count = tuple(stop - start for start, stop in extent)
        chunks.append(Chunk(count, pixels, pairs.start, block[pairs] - first, layer[pairs], counts, runs))
    return Plan(grid, used, number, chunks)


def _halved(grid: Grid, ends: list[int], limit: int) -> Iterator[Extent]:
    """Halve the blocks, images first, then rows, then columns, until a part has ``limit`` pairs or is one block.

    ``ends`` counts the pairs before each block.
    """
    stack: list[Extent] = [((0, grid.batch), (0, grid.rows), (0, grid.columns))]
    while stack:
        extent = stack.pop()
        first, last = grid.first(extent)
        axis = next((a for a in range(3) if extent[a][1] - extent[a][0] > 1), None)
        if axis is None or ends[last] - ends[first] <= limit:
            yield extent
            continue
        start, stop = extent[axis]
        middle = (start + stop) // 2
        stack += [(*extent[:axis], half, *extent[axis + 1 :]) for half in ((middle, stop), (start, middle))]


def _runs(layers: list[int], counts: list[int]) -> Iterator[tuple[slice, slice, slice]]:
    """Yield the runs of blocks with so many pairs each, of these layers."""
    start = 0
    for block, count in enumerate(counts):
        stop = start + count
        breaks = (pair for pair in range(start + 1, stop) if layers[pair] != layers[pair - 1] + 1)
        for first, last in pairwise([start, *breaks, stop]):
            yield slice(block, block + 1), slice(first, last), slice(layers[first], layers[last - 1] + 1)
        start = stop


def part_of(planes: Tensor, chunk: Chunk, grid: Grid) -> Tensor:
    """Return the windows of a chunk in (B, ..., H', W') planes, with zeros beyond their ends.

    Args:
        planes: windows of the first tile start at their first pixel.
        chunk: of the plan.
        grid: of the plan.
    """
    images, y, x = chunk.pixels
    (_, rows, columns), (down, across) = chunk.extent, grid.tile
    height, width = rows * down + grid.lost, columns * grid.across * across + grid.lost
    part = planes[images, ..., y.start : y.start + height, x.start : x.start + width]
    missing = (0, width - part.shape[-1], 0, height - part.shape[-2])
    return pad(part, missing) if any(missing) else part


def windows(part: Tensor, grid: Grid) -> Tensor:
    """Return the windows (blocks, ..., height, width, across) in what :func:`part_of` returned.

    Those of two tiles side by side are a complex plane, see :func:`torch.view_as_complex`.

    Example:
        >>> windows(torch.arange(10.0).view(1, 2, 5), Grid(1, (1, 4), 1, (2, 3), across=2)).shape
        torch.Size([1, 2, 3, 2])
    """
    (height, width), (down, across) = grid.size, grid.tile
    tiles = part.unfold(-2, height, down).unfold(-2, width, across).unflatten(-3, (-1, grid.across))
    return torch.stack(tiles.movedim((-5, -4), (1, 2)).unbind(-3), -1).flatten(0, 2)
