"""Tiles: how a plane is cut up so that each piece meets only the layers it contains.

A block is ``tile`` rows by ``2 tile`` columns: two tiles side by side. Seen through PSFs of P pixels, a tile needs a
window of ``size = tile + P - 1`` pixels a side. The left window is the real and the right one the imaginary part of a
single complex plane: PSFs are real, so one complex transform serves both, at half the price of two.

A pair is a block and a layer present in it. Each pair owns a complex plane of ``size`` x ``size`` for each channel, and
each pixel has one place in the planes of each of its layers. Blocks are numbered image by image, row by row; pairs by
block, then by layer.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from kornia_tidy.scene.convolution import next_fast_size

# Sides of transforms: of the sizes without a prime factor above 5, those that transform fast everywhere.
SIZES = (8, 12, 16, 24, 32, 36, 48, 64, 72, 96, 128, 144, 192, 256, 288, 384, 512, 576, 768, 1024, 1152, 1536, 2048)
# Bytes that the planes of a chunk may take: in a processor's cache, or enough to keep an accelerator busy.
CHUNK_BYTES = {"cpu": 6 << 20}
CHUNK_BYTES_ACCELERATOR = 256 << 20


@dataclass(frozen=True)
class Labels:
    """The layers of each pixel: all light to layer ``first``, or shared with the next one.

    Args:
        first: (B, H, W) int64 index of a layer.
        fraction: (B, H, W) share of layer ``first + 1``, or None for nearest layers.
        sloped: the gradient with respect to ``fraction`` is wanted, so that a share of zero matters too.
    """

    first: Tensor
    fraction: Tensor | None
    sloped: bool

    def terms(self, *where: slice) -> list[Tensor]:
        """Return the one or two layers of each pixel there. Where two are equal the pixel belongs to that layer."""
        first = self.first[where]
        if self.fraction is None:
            return [first]
        if self.sloped:
            return [first, first + 1]
        fraction = self.fraction[where]
        return [first + (fraction == 1), first + (fraction > 0)]

    def every(self, step: int) -> Labels:
        """Return the labels of every ``step``-th row and column."""
        fraction = None if self.fraction is None else self.fraction[:, ::step, ::step]
        return replace(self, first=self.first[:, ::step, ::step], fraction=fraction)

    def present(self, count: int) -> Tensor:
        """Return (count,) bool: which of the indices occur."""
        present = torch.zeros(count, dtype=torch.bool, device=self.first.device)
        for image in range(len(self.first)):
            for term in self.terms(slice(image, image + 1)):
                present.index_fill_(0, term.flatten(), True)
        return present


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
    def blocks(self) -> int:
        """Blocks of all images."""
        return self.batch * self.rows * self.columns

    def number(self, labels: Labels, layers: int, step: int = 1) -> Labels:
        """Return labels that number block and layer: block * layers + layer. Labels are of every ``step``-th pixel."""
        device = labels.first.device
        row = torch.arange(0, self.height, step, device=device).div_(self.tile, rounding_mode="floor")
        column = torch.arange(0, self.width, step, device=device).div_(2 * self.tile, rounding_mode="floor")
        image = torch.arange(self.batch, device=device)[:, None] * self.rows
        rows = ((image + row) * (self.columns * layers)).unsqueeze(-1)
        return replace(labels, first=(labels.first + column * layers).add_(rows))


@dataclass(frozen=True)
class Chunk:
    """Blocks that are worked on together: some images, or some rows of one image, or a part of one row.

    Args:
        batch: images.
        rows: rows of blocks.
        columns: columns of blocks.
        y: rows of pixels.
        x: columns of pixels.
        first_pair: number of the first pair.
        block: (N,) block of each pair, counted from the chunk's first.
        runs: pairs that share a layer, counted from the chunk's first, and that layer as an index into
            :attr:`Plan.present`.
    """

    batch: slice
    rows: slice
    columns: slice
    y: slice
    x: slice
    first_pair: int
    block: Tensor
    runs: list[tuple[int, slice]]

    @property
    def extent(self) -> tuple[int, int, int]:
        """Images, rows and columns of blocks."""
        images, rows, columns = (part.stop - part.start for part in (self.batch, self.rows, self.columns))
        return images, rows, columns

    def pixels(self, channel: int) -> tuple[slice, int, slice, slice]:
        """Index of its pixels in (B, C, H, W)."""
        return self.batch, channel, self.y, self.x


@dataclass(frozen=True)
class Plan:
    """What is computed for one scene.

    Args:
        grid: the blocks.
        present: (D',) the layers that the scene contains.
        labels: the block and layer of each pixel as one number, see :meth:`Grid.number`.
        place: (blocks * D,) where the planes of a block and layer start, in floats; of no meaning if it is not a pair.
        stride: floats from one pair's planes to the next.
        chunks: the blocks in the order they are worked on.
    """

    grid: Grid
    present: Tensor
    labels: Labels
    place: Tensor
    stride: int
    chunks: list[Chunk]


def make_plan(labels: Labels, layers: int, psf_size: int, channels: int) -> Plan:
    """Choose the tiles for a scene, list the pairs of block and layer, and group them into chunks."""
    device = labels.first.device
    grid = choose_grid(labels, layers, psf_size)
    stride = 2 * channels * grid.size**2
    itemsize = 4 if labels.fraction is None else labels.fraction.element_size()
    limit = CHUNK_BYTES.get(device.type, CHUNK_BYTES_ACCELERATOR) // (stride * itemsize)

    labels = grid.number(labels, layers)
    pairs = labels.present(grid.blocks * layers)
    used = pairs.view(-1, layers).any(0)
    pairs = pairs.nonzero().squeeze(-1)
    block, layer = pairs // layers, pairs % layers
    ends = torch.zeros(grid.blocks + 1, dtype=torch.int64, device=device)
    ends[1:] = torch.bincount(block, minlength=grid.blocks).cumsum(0)
    extents = list(_split(grid, ends.tolist(), limit))

    # Within a chunk the pairs go by layer, so that a spectrum is fetched once for all pairs that share it.
    lengths = torch.tensor([last - first for _, first, last in extents], device=device)
    chunk_of_block = torch.arange(len(extents), device=device).repeat_interleave(lengths)
    group, order = (chunk_of_block[block] * layers + layer).sort(stable=True)
    pairs, block = pairs[order], block[order]
    place = torch.zeros(grid.blocks * layers, dtype=torch.int64, device=device)
    place[pairs] = torch.arange(len(pairs), device=device) * stride
    runs = _runs(group, layers, used.cumsum(0) - 1, len(extents))

    chunks = []
    first_pair = 0
    for extent, chunk_runs in zip(extents, runs, strict=True):
        last_pair = first_pair + chunk_runs[-1][1].stop
        chunks.append(_chunk(grid, extent, first_pair, block[first_pair:last_pair], chunk_runs))
        first_pair = last_pair
    return Plan(grid, used.nonzero().squeeze(-1), labels, place, stride, chunks)


def choose_grid(labels: Labels, layers: int, psf_size: int) -> Grid:
    """Return the grid with the lowest cost.

    Larger tiles waste less on their overlap, smaller ones hold fewer layers. The pairs of each candidate are counted
    on every fourth row and column. Cost in nanoseconds, measured on one core of a 2.5 GHz Xeon in float32: a sample of
    a complex transform takes 0.18 log2(size^2); cutting a block out 1 a sample; fetching its spectrum and multiplying
    it 1.8 a sample and pair.
    """
    batch, height, width = labels.first.shape
    smallest = 2 * psf_size - 1  # a tile is no shorter than its overlap: only next neighbours overlap
    whole = psf_size - 1 + max(height, math.ceil(width / 2))
    sizes = [size for size in SIZES if smallest <= size < 2 * whole][:6] or [next_fast_size(smallest)]
    grids = [Grid(batch, height, width, size, size - psf_size + 1) for size in sizes]
    if len(grids) == 1:
        return grids[0]
    step = 4
    sample = labels.every(step)
    counts = [grid.number(sample, layers, step).present(grid.blocks * layers).sum() for grid in grids]
    costs = []
    for grid, pairs in zip(grids, torch.stack(counts).tolist(), strict=True):
        transform = 0.18 * math.log2(grid.size**2)
        costs.append(grid.size**2 * (grid.blocks * (transform + 1) + pairs * (transform + 1.8)))
    return grids[costs.index(min(costs))]


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
        for part in (((start + stop) // 2, stop), (start, (start + stop) // 2)):
            stack.append((*extent[:axis], part, *extent[axis + 1 :]))


def _runs(group: Tensor, layers: int, index: Tensor, chunks: int) -> list[list[tuple[int, slice]]]:
    """For each chunk: the layers it contains, as ``index`` numbers them, and where their pairs lie in the chunk."""
    groups, counts = group.unique_consecutive(return_counts=True)
    runs: list[list[tuple[int, slice]]] = [[] for _ in range(chunks)]
    numbers = torch.stack([groups // layers, index[groups % layers], counts])
    for chunk, layer, count in numbers.T.tolist():
        start = runs[chunk][-1][1].stop if runs[chunk] else 0
        runs[chunk].append((layer, slice(start, start + count)))
    return runs


def _chunk(grid: Grid, part: tuple[Extent, int, int], first_pair: int, block: Tensor, runs: list) -> Chunk:
    (images, rows, columns), first_block, _ = part
    return Chunk(
        batch=slice(*images),
        rows=slice(*rows),
        columns=slice(*columns),
        y=slice(rows[0] * grid.tile, min(rows[1] * grid.tile, grid.height)),
        x=slice(columns[0] * 2 * grid.tile, min(columns[1] * 2 * grid.tile, grid.width)),
        first_pair=first_pair,
        block=block - first_block,
        runs=runs,
    )
