"""Tiles: how a plane is cut up so that each piece meets only the layers it contains.

A block is ``tile`` rows by ``2 tile`` columns: two tiles side by side. Seen through PSFs of P pixels, a tile needs a
window of ``size = tile + P - 1`` pixels a side. The left window is the real and the right one the imaginary part of a
single complex plane: PSFs are real, so one complex transform serves both, at half the price of two.

A pair is a block and a layer present in it. Each pair owns a complex plane of ``size`` x ``size``, and each pixel has
one place in the planes of each of its layers; channels are worked on one after the other. Blocks are numbered image by
image, row by row; pairs by block, then by layer.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from kornia_tidy.render.borders import next_fast_size

# Sides of transforms whose samples take the least time.
SIZES = (
    *(8, 12, 16, 24, 32, 48, 64, 72, 80, 96, 112, 128, 144, 160, 192, 200, 216, 240, 256, 288, 320, 384),
    *(512, 576, 768, 1024, 1536, 2048),
)
# Bytes that the planes of a chunk may take in one channel: near a processor's cache (and see kept_memory.py), or enough
# to keep an accelerator busy.
CHUNK_BYTES = {"cpu": 5 << 20}
CHUNK_BYTES_ACCELERATOR = 256 << 20
TILE_FACTOR = 1.1  # of what windows take over the cost by which they are chosen
PIXEL_NANOSECONDS = 8.5  # of a pixel and each layer that it takes light from
SAMPLE = 8  # px between the rows and columns on which the layers of candidates are counted


@dataclass(frozen=True)
class Labels:
    """The layers of each pixel: all light to layer ``lower``, or a share of it to the next one.

    Args:
        lower: (B, H, W) int64 index of a layer, from :func:`~kornia_tidy.render.layers.assign_layers`.
        fraction: (B, H, W) share of the next layer, or None for nearest layers.
        sloped: a layer with a share of zero counts too, for its gradient.
    """

    lower: Tensor
    fraction: Tensor | None
    sloped: bool = False

    @classmethod
    def of(cls, lower: Tensor, fraction: Tensor | None) -> Labels:
        """Return the labels of layers as they were assigned, sloped where a gradient of ``fraction`` is wanted."""
        if fraction is None:
            return cls(lower, None)
        return cls(lower, fraction.detach(), fraction.requires_grad and torch.is_grad_enabled())

    def every(self, step: int) -> Labels:
        """Return the labels of every ``step``-th row and column."""
        kept = (slice(None), slice(None, None, step), slice(None, None, step))
        return Labels(self.lower[kept], None if self.fraction is None else self.fraction[kept], self.sloped)

    def terms(self, *where: slice) -> list[Tensor]:
        """Return the one or two layers of each pixel there: the same twice if it lies in one."""
        lower = self.lower[where]
        if self.fraction is None:
            return [lower]
        if self.sloped:
            return [lower, lower + 1]
        share = self.fraction[where]
        return [lower + (share == 1), lower + (share > 0)]


@dataclass(frozen=True)
class Grid:
    """Blocks over a batch of planes of ``height`` x ``width`` pixels."""

    batch: int
    height: int
    width: int
    size: int
    tile: int

    @property
    def rows(self) -> int:
        """Blocks from top to bottom."""
        return math.ceil(self.height / self.tile)

    @property
    def columns(self) -> int:
        """Blocks from left to right."""
        return math.ceil(self.width / (2 * self.tile))

    @property
    def covered_height(self) -> int:
        """Height of all blocks: the last ones may reach beyond the plane."""
        return self.rows * self.tile

    @property
    def covered_width(self) -> int:
        """Width of all blocks."""
        return self.columns * 2 * self.tile

    @property
    def blocks(self) -> int:
        """Blocks of all images."""
        return self.batch * self.rows * self.columns

    def number(self, images: Tensor, y: Tensor, x: Tensor) -> Tensor:
        """Return the block of pixels, (images, y, x), by their indices along each axis."""
        rows, columns = y // self.tile, x // (2 * self.tile)
        return (images[:, None, None] * self.rows + rows[:, None]) * self.columns + columns

    def present(self, labels: Labels, layers: int, step: int = 1) -> Tensor:
        """Return (blocks, layers) bool: which of the layers a block contains. Labels are of every ``step``-th pixel."""
        device = labels.lower.device
        images = torch.arange(self.batch, device=device)
        y, x = (torch.arange(0, side, step, device=device) for side in (self.height, self.width))
        row, column = self.number(images, y, x[:1]) * layers, self.number(images[:1], y[:1], x) * layers
        present = torch.zeros(self.blocks * layers, dtype=torch.bool, device=device)
        for first in range(0, len(y), 64):  # in a processor's cache
            part = slice(first, first + 64)
            for layer in labels.terms(slice(None), part):
                present.index_fill_(0, (layer + column).add_(row[:, part]).reshape(-1), True)
        return present.view(-1, layers)


class Run(NamedTuple):
    """Pairs of one block whose layers follow one another: one product with their spectra serves them all."""

    block: int
    pairs: slice
    layers: slice


@dataclass(frozen=True)
class Chunk:
    """Blocks that are worked on together: some images, or some rows of one image, or a part of one row.

    Args:
        batch: images.
        rows: rows of blocks.
        columns: columns of blocks.
        y: rows of pixels.
        x: columns of pixels.
        block: (N,) block of each pair, counted from the chunk's first.
        layer: (N,) layer of each pair, as an index into :attr:`Plan.present`.
        counts: pairs of each block.
    """

    batch: slice
    rows: slice
    columns: slice
    y: slice
    x: slice
    block: Tensor
    layer: Tensor
    counts: list[int]

    @property
    def extent(self) -> tuple[int, int, int]:
        """Images, rows and columns of blocks."""
        images, rows, columns = (part.stop - part.start for part in (self.batch, self.rows, self.columns))
        return images, rows, columns

    @cached_property
    def runs(self) -> list[Run]:
        """Its pairs, in as few runs as they make."""
        block, layer = self.block.tolist(), self.layer.tolist()
        starts = [
            pair
            for pair in range(len(block))
            if pair == 0 or block[pair] != block[pair - 1] or layer[pair] != layer[pair - 1] + 1
        ]
        return [
            Run(block[start], slice(start, stop), slice(layer[start], layer[stop - 1] + 1))
            for start, stop in pairwise([*starts, len(block)])
        ]

    @property
    def pixels(self) -> tuple[slice, slice, slice]:
        """Index of its pixels in (B, H, W)."""
        return self.batch, self.y, self.x


@dataclass(frozen=True)
class Plan:
    """What is computed for one scene.

    Args:
        grid: the blocks.
        present: (D',) the layers that the scene contains.
        labels: the layers of each pixel.
        start: (blocks, D) where the plane of a block and layer starts among its chunk's, in floats; of no meaning if
            they are not a pair.
        chunks: the blocks in the order they are worked on.
    """

    grid: Grid
    present: Tensor
    labels: Labels
    start: Tensor
    chunks: list[Chunk]


def make_plan(labels: Labels, layers: int, psf_size: int) -> Plan:
    """Choose the tiles for a scene, list the pairs of block and layer, and group them into chunks."""
    device = labels.lower.device
    grid = choose_grid(labels, layers, psf_size)
    stride = 2 * grid.size**2
    itemsize = 4 if labels.fraction is None else labels.fraction.element_size()
    limit = CHUNK_BYTES.get(device.type, CHUNK_BYTES_ACCELERATOR) // (stride * itemsize)

    here = grid.present(labels, layers)
    used = here.any(0)
    block, layer = here.nonzero().unbind(1)
    number = (used.cumsum(0) - 1)[layer]
    ends = [0, *here.sum(1).cumsum(0).tolist()]
    start = torch.zeros(grid.blocks, layers, dtype=torch.int64, device=device)
    chunks = []
    for extent, first, last in _split(grid, ends, limit):
        own = slice(ends[first], ends[last])
        start[block[own], layer[own]] = torch.arange(0, (own.stop - own.start) * stride, stride, device=device)
        counts = [stop - start for start, stop in pairwise(ends[first : last + 1])]
        chunks.append(_chunk(grid, extent, block[own] - first, number[own], counts))
    return Plan(grid, used.nonzero().squeeze(-1), labels, start, chunks)


def choose_grid(labels: Labels, layers: int, psf_size: int) -> Grid:
    """Return the grid with the lowest cost.

    Larger tiles waste less on their overlap, smaller ones hold fewer layers. The pairs of each candidate are counted
    on every eighth row and column.
    """
    grids = candidates(tuple(labels.lower.shape), psf_size)
    if len(grids) == 1:
        return grids[0]
    sample = labels.every(SAMPLE)
    counts = [grid.present(sample, layers, SAMPLE).sum() for grid in grids]
    counted = zip(grids, torch.stack(counts).tolist(), strict=True)
    costs = [tile_cost(grid.size, grid.blocks, pairs) for grid, pairs in counted]
    return grids[costs.index(min(costs))]


def candidates(shape: tuple[int, ...], psf_size: int) -> list[Grid]:
    """Return the grids to choose from, for labels of a shape."""
    batch, height, width = shape
    smallest = 2 * psf_size - 1  # a tile is no shorter than its overlap: only next neighbours overlap
    whole = psf_size - 1 + max(height, math.ceil(width / 2))
    sizes = [size for size in SIZES if smallest <= size < 2 * whole][:8] or [next_fast_size(smallest)]
    return [_fitting_grid(batch, height, width, size, psf_size) for size in sizes]


def tile_cost(size: int, blocks: int, pairs: int) -> float:
    r"""Return the time that windows take in nanoseconds a channel, on a core of a 2.5 GHz Xeon in float32.

    .. math:: n^2 \left( B (t + 1.8) + N (t + 1.5) \right) + 2000 N, \qquad t = 0.09 \log_2 n^2

    for B blocks and N pairs with windows of n x n samples: t to transform a sample, 1.8 to cut it out of the image,
    1.5 to fetch its spectrum and multiply it; and 2000 to call for a pair at all.

    Example:
        >>> f"{tile_cost(72, 299, 1044) * 3e-6:.0f} ms"
        '62 ms'
    """
    transform = 0.09 * math.log2(size**2)
    return size**2 * (blocks * (transform + 1.8) + pairs * (transform + 1.5)) + 2000 * pairs


def transforms_cost(windows: float, pixels: int, terms: int) -> float:
    """Return the time of rendering by transforms in nanoseconds a channel, like :func:`tile_cost`.

    Args:
        windows: what windows and spectra take, from :func:`tile_cost`.
        pixels: of the output, over the batch.
        terms: layers that a pixel takes light from, 1 or 2.

    Example:
        >>> f"{transforms_cost(tile_cost(72, 299, 1044), 1110 * 1282, 1) * 3e-6:.0f} ms"
        '105 ms'
    """
    return TILE_FACTOR * windows + PIXEL_NANOSECONDS * pixels * terms


def _fitting_grid(batch: int, height: int, width: int, size: int, psf_size: int) -> Grid:
    """Return the grid of the fewest blocks, in tiles no larger than needed: the last hang over the least."""
    largest = size - psf_size + 1
    rows, columns = math.ceil(height / largest), math.ceil(width / (2 * largest))
    tile = max(math.ceil(height / rows), math.ceil(width / (2 * columns)), (size + 1) // 2)
    return Grid(batch, height, width, size, min(tile, largest))


Extent = tuple[tuple[int, int], ...]  # first and last image, row and column of blocks


def _split(grid: Grid, ends: list[int], limit: int) -> Iterator[tuple[Extent, int, int]]:
    """Halve the blocks, images first, then rows, then columns, until a part has ``limit`` pairs or is one block.

    ``ends`` counts the pairs before each block. Yields parts in order, with their first and last block.
    """
    stack: list[Extent] = [((0, grid.batch), (0, grid.rows), (0, grid.columns))]
    while stack:
        extent = stack.pop()
        (image, last_image), (row, last_row), (column, last_column) = extent
        first = (image * grid.rows + row) * grid.columns + column
        last = ((last_image - 1) * grid.rows + last_row - 1) * grid.columns + last_column
        axis = next((a for a in range(3) if extent[a][1] - extent[a][0] > 1), None)
        if axis is None or ends[last] - ends[first] <= limit:
            yield extent, first, last
            continue
        start, stop = extent[axis]
        middle = (start + stop) // 2
        stack += [(*extent[:axis], half, *extent[axis + 1 :]) for half in ((middle, stop), (start, middle))]


def _chunk(grid: Grid, extent: Extent, block: Tensor, layer: Tensor, counts: list[int]) -> Chunk:
    images, rows, columns = extent
    return Chunk(
        batch=slice(*images),
        rows=slice(*rows),
        columns=slice(*columns),
        y=slice(rows[0] * grid.tile, min(rows[1] * grid.tile, grid.height)),
        x=slice(columns[0] * 2 * grid.tile, min(columns[1] * 2 * grid.tile, grid.width)),
        block=block,
        layer=layer,
        counts=counts,
    )
