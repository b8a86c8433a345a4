"""The plan of gather and scatter by tiles: pairs of a block and a layer, in chunks that are worked on together.

A pair is a block and a layer present in it. Each pair owns a complex plane of ``size`` x ``size``, and each pixel has
one place in the planes of each of its layers; channels are worked on one after the other. Blocks are numbered image by
image, row by row; pairs by block, then by layer.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

from kornia_tidy.render.backends.tile_plan import Grid, TileKind
from kornia_tidy.render.scene import Labels


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
        extent: images, rows and columns of blocks.
        pixels: images, rows and columns of pixels, an index into (B, H, W).
        block: (N,) block of each pair, counted from the chunk's first.
        layer: (N,) layer of each pair, as an index into :attr:`BlockPlan.present`.
        counts: pairs of each block.
        runs: its pairs, in as few runs as they make.
    """

    batch: slice
    rows: slice
    columns: slice
    extent: tuple[int, int, int]
    pixels: tuple[slice, slice, slice]
    block: Tensor
    layer: Tensor
    counts: list[int]
    runs: list[Run]


@dataclass(frozen=True)
class BlockPlan:
    """The pairs of blocks and layers of one scene, in chunks.

    Args:
        grid: the blocks.
        present: (D',) the layers that the scene contains.
        labels: the layers of each pixel.
        start: (blocks, D) where the plane of a block and layer starts among its chunk's, in floats; of no meaning if
            they are not a pair.
        number: (images, rows, columns) block of each pixel of the largest chunk, times D, counted from its first block.
        inside: (rows, columns) where each of these pixels stands in its plane, in floats.
        chunks: the blocks in the order they are worked on.
        by_slices: pairs are multiplied run by run, which passes over a processor's memory less often; otherwise all at
            once, which starts fewer kernels on an accelerator.
    """

    grid: Grid
    present: Tensor
    labels: Labels
    start: Tensor
    number: Tensor
    inside: Tensor
    chunks: list[Chunk]
    by_slices: bool


def plan_blocks(labels: Labels, layers: int, grid: Grid, kind: TileKind, offset: int) -> BlockPlan:
    """List the pairs of block and layer of a grid, and group them into chunks.

    Args:
        labels: the layers of each pixel.
        layers: number of layers D.
        grid: the blocks.
        kind: of the tiles.
        offset: where a tile's first pixel stands in its window, down and across.
    """
    device = labels.layer_index.device
    stride = 2 * grid.size**2
    itemsize = 4 if labels.layer_weight is None else labels.layer_weight.element_size()
    limit = (kind.chunk_bytes if device.type == "cpu" else kind.accelerator_bytes) // (stride * itemsize)

    here = grid.present(labels, layers)
    used = here.any(0)
    block, layer = here.nonzero().unbind(1)
    number = (used.cumsum(0) - 1)[layer]
    ends = [0, *here.sum(1).cumsum(0).tolist()]
    start = torch.zeros(len(here), layers, dtype=torch.int64, device=device)
    chunks = []
    for extent, first, last in _split(grid, ends, limit):
        own = slice(ends[first], ends[last])
        start[block[own], layer[own]] = torch.arange(0, (own.stop - own.start) * stride, stride, device=device)
        counts = [stop - start for start, stop in pairwise(ends[first : last + 1])]
        chunks.append(_chunk(grid, extent, block[own] - first, number[own], counts))
    images = torch.arange(max(chunk.extent[0] for chunk in chunks), device=device)
    y = torch.arange(max(chunk.extent[1] for chunk in chunks) * grid.tile, device=device)
    x = torch.arange(grid.width, device=device)
    number = grid.number(images, y, x) * layers  # alike for all rows of blocks
    down, across = y % grid.tile + offset, x % grid.tile + offset
    inside = (down * (2 * grid.size))[:, None] + (2 * across + x // grid.tile % 2)
    by_slices = device.type == "cpu"
    return BlockPlan(grid, used.nonzero().squeeze(-1), labels, start, number, inside, chunks, by_slices)


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
    (image, last_image), (row, last_row), (column, last_column) = extent
    down, across = grid.tile, grid.across * grid.tile
    y = slice(row * down, min(last_row * down, grid.height))
    x = slice(column * across, min(last_column * across, grid.width))
    numbers, layers = block.tolist(), layer.tolist()
    starts = [
        pair
        for pair in range(len(numbers))
        if pair == 0 or numbers[pair] != numbers[pair - 1] or layers[pair] != layers[pair - 1] + 1
    ]
    runs = [
        Run(numbers[start], slice(start, stop), slice(layers[start], layers[stop - 1] + 1))
        for start, stop in pairwise([*starts, len(numbers)])
    ]
    return Chunk(
        batch=slice(image, last_image),
        rows=slice(row, last_row),
        columns=slice(column, last_column),
        extent=(last_image - image, last_row - row, last_column - column),
        pixels=(slice(image, last_image), y, x),
        block=block,
        layer=layer,
        counts=counts,
        runs=runs,
    )
