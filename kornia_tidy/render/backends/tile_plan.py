"""Tiles: how a plane is cut into pieces that each meet only the layers they contain.

Seen through PSFs of P pixels, a tile needs a window of ``size = tile + P - 1`` pixels a side, which is transformed.
Larger tiles waste less on their overlap, smaller ones hold fewer layers: the grid with the lowest cost is chosen from a
sample of the scene's labels. Gather and scatter work on blocks of two tiles (:data:`BLOCKS`), in C on single ones
(:data:`OVERLAPS`), occlusion on single windows (:data:`WINDOWS`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from kornia_tidy.render.borders import next_fast_size
from kornia_tidy.render.cost_model import OverlapWork, TiledOcclusionWork, TiledWork, seconds_of
from kornia_tidy.render.cost_profile import EPYC, CostProfile
from kornia_tidy.render.scene import SAMPLE, Labels

TileWork = TiledWork | TiledOcclusionWork


@dataclass(frozen=True)
class TileKind:
    """Sizes and limits of the tiles of gather and scatter, or of occlusion.

    Args:
        sizes: sides of windows to choose from, in samples.
        candidates: how many of them are tried at most.
        across: tiles that stand side by side in a block.
        windowed: a layer counts wherever it lies in the window, not only in the tile.
        chunk_bytes: that the planes of a chunk may take on a processor, near its cache (see allocator.py), and
        accelerator_bytes: on an accelerator, enough to keep it busy.
        every: sides are multiples of it.
        work: what the work of gather and scatter is counted as.
    """

    sizes: tuple[int, ...]
    candidates: int
    across: int
    windowed: bool
    chunk_bytes: int
    accelerator_bytes: int = 256 << 20
    every: int = 1
    work: type[TiledWork] = TiledWork


# A block is two tiles: the left window is the real and the right one the imaginary part of a complex plane, so that one
# transform serves both. The sizes are those with the fastest transforms. Bytes are those of one channel.
BLOCKS = TileKind(
    sizes=(
        *(8, 12, 16, 24, 32, 48, 64, 72, 80, 96, 112, 128, 144, 160, 192, 200, 216, 240, 256, 288, 320, 384),
        *(512, 576, 768, 1024, 1536, 2048),
    ),
    candidates=8,
    across=2,
    windowed=False,
    chunk_bytes=5 << 20,
)
# Transforms in C, of vectors of rows and of columns. Nothing is held but a window and the spectra of the PSFs.
OVERLAPS = TileKind(
    sizes=tuple(32 * n for n in range(1, 65) if next_fast_size(n) == n),
    candidates=8,
    across=1,
    windowed=False,
    chunk_bytes=0,
    every=32,
    work=OverlapWork,
)
# With occlusion the neighbours of a tile emit and hide light in it. Bytes are those of all channels.
WINDOWS = TileKind(
    sizes=(16, 24, 32, 36, 48, 64, 72, 96, 128, 144, 192, 256, 288, 384, 512, 768, 1024),
    candidates=17,
    across=1,
    windowed=True,
    chunk_bytes=4 << 20,
)


@dataclass(frozen=True)
class Grid:
    """Blocks over a batch of planes of ``height`` x ``width`` pixels, numbered image by image, row by row.

    Args:
        batch: images.
        height: of a plane, in pixels.
        width: of a plane, in pixels.
        size: side of a window in pixels.
        tile: side of a tile in pixels.
        across: tiles that stand side by side in a block.
        reach: pixels beyond its lower and right end in which a layer counts as a block's own.
        rows: blocks from top to bottom; the last ones may reach beyond the plane.
        columns: blocks from left to right.
        spare: rows and columns by which the last blocks reach beyond the plane.
    """

    batch: int
    height: int
    width: int
    size: int
    tile: int
    across: int
    reach: int
    rows: int
    columns: int
    spare: tuple[int, int]

    @property
    def blocks(self) -> int:
        """Blocks of all images."""
        return self.batch * self.rows * self.columns

    def number(self, images: Tensor, y: Tensor, x: Tensor) -> Tensor:
        """Return the block of pixels, (images, y, x), by their indices along each axis."""
        rows, columns = y // self.tile, x // (self.across * self.tile)
        rows, columns = rows.clamp_(max=self.rows - 1), columns.clamp_(max=self.columns - 1)
        return (images[:, None, None] * self.rows + rows[:, None]) * self.columns + columns

    def corner(self, number: int) -> tuple[int, int, int]:
        """Return the image of a block, its first row and its first column."""
        rest, column = divmod(number, self.columns)
        image, row = divmod(rest, self.rows)
        return image, row * self.tile, column * self.across * self.tile

    def present(self, labels: Labels, layers: int, step: int = 1) -> Tensor:
        """Return (blocks, layers) bool: which of the layers a block contains. Labels are of every ``step``-th pixel."""
        device, blocks = labels.layer_index.device, self.batch * self.rows * self.columns
        images = torch.arange(self.batch, device=device)
        y = torch.arange(0, self.height + self.reach, step, device=device)
        x = torch.arange(0, self.width + self.reach, step, device=device)
        row, column = self.number(images, y, x[:1]) * layers, self.number(images[:1], y[:1], x) * layers
        present = torch.zeros(blocks * layers, dtype=torch.bool, device=device)
        for first in range(0, len(y), 64):  # in a processor's cache
            part = slice(first, first + 64)
            for layer in labels.terms(slice(None), part):
                keys = (layer + column).add_(row[:, part])
                present.index_fill_(0, keys.reshape(-1), True)
                if self.reach:
                    above = keys[:, self._reached(y[part], self.tile, self.rows)] - self.columns * layers
                    present.index_fill_(0, above.reshape(-1), True)
                    before = self._reached(x, self.across * self.tile, self.columns)
                    for own in (keys, above):
                        present.index_fill_(0, own[..., before].sub_(layers).reshape(-1), True)
        return present.view(-1, layers)

    def _reached(self, pixels: Tensor, block: int, blocks: int) -> Tensor:
        """Return which pixels along an axis count for the block before their own too, bool."""
        own = (pixels // block).clamp_(max=blocks - 1)
        return (pixels - own * block < self.reach) & (own > 0)


def choose_grid(labels: Labels, layers: int, psf_size: int, kind: TileKind = BLOCKS) -> Grid:
    """Return the grid with the lowest cost, see :func:`cheapest_grid`."""
    grids = candidates(tuple(labels.layer_index.shape), psf_size, kind)
    return grids[0] if len(grids) == 1 else cheapest_grid(labels, layers, psf_size, kind)[1]


def cheapest_grid(labels: Labels, layers: int, psf_size: int, kind: TileKind) -> tuple[TileWork, Grid]:
    """Return the work of the grid that takes the least time, in float32 and for one channel, and the grid.

    The layers of each candidate's blocks are found on every eighth row and column.

    Args:
        labels: of all pixels of the scene.
        layers: number of layers D.
        psf_size: side P of the PSFs.
        kind: of the tiles.
    """
    grids, blended = (
        candidates(tuple(labels.layer_index.shape), psf_size, kind),
        1 if labels.layer_weight is None else 2,
    )
    sample = labels.every(SAMPLE)
    works = _works(grids, [grid.present(sample, layers, SAMPLE) for grid in grids], blended, kind)
    return _cheapest(works, grids, EPYC)


@lru_cache(maxsize=256)
def least_work(shape: tuple[int, ...], psf_size: int, blended: int, kind: TileKind, profile: CostProfile) -> TileWork:
    """Return the work for labels of a shape with one layer in each block, in float32 and for one channel."""
    grids = candidates(shape, psf_size, kind)
    works = _works(grids, [torch.ones(grid.blocks, 1, dtype=torch.bool) for grid in grids], blended, kind)
    return _cheapest(works, grids, profile)[0]


def least_windows(labels: Labels, layers: int, psf_size: int, kind: TileKind) -> TileWork:
    """Return the work where larger windows hold no more layers than the smallest ones do on average."""
    grids = candidates(tuple(labels.layer_index.shape), psf_size, kind)
    held = float(grids[0].present(labels.every(SAMPLE), layers, SAMPLE).sum(1).double().mean())
    few = max(1, int(held))  # some windows hold so many, the rest one more
    works = []
    for grid in grids:
        more = int((held - few) * grid.blocks) if held > few else 0
        counts = (*(0 for _ in range(few)), grid.blocks - more, more)
        works.append(TiledOcclusionWork(grid.size, counts, grid.batch * grid.height * grid.width))
    return _cheapest(works, grids, EPYC)[0]


def candidates(shape: tuple[int, ...], psf_size: int, kind: TileKind = BLOCKS) -> list[Grid]:
    """Return the grids to choose from, for labels of a shape."""
    batch, height, width = shape
    if kind.windowed:  # labels are those of the windows
        height, width = height - psf_size + 1, width - psf_size + 1
    smallest = 2 * psf_size - 1  # a tile is no shorter than its overlap: only next neighbours overlap
    whole = psf_size - 1 + max(height, math.ceil(width / kind.across))
    sizes = [size for size in kind.sizes if smallest <= size < 2 * whole][: kind.candidates]
    only = kind.every * next_fast_size(math.ceil(smallest / kind.every))
    return [_grid(batch, height, width, size, psf_size, kind) for size in sizes or [only]]


def _grid(batch: int, height: int, width: int, size: int, psf_size: int, kind: TileKind) -> Grid:
    """Return the grid of the fewest blocks; where overlap is free, in tiles no larger than needed."""
    tile, reach = size - psf_size + 1, psf_size - 1 if kind.windowed else 0
    rows, columns = math.ceil(height / tile), math.ceil(width / (kind.across * tile))
    if not kind.windowed:
        tile = min(tile, max(math.ceil(height / rows), math.ceil(width / (kind.across * columns)), (size + 1) // 2))
        rows, columns = math.ceil(height / tile), math.ceil(width / (kind.across * tile))
    spare = rows * tile - height, columns * kind.across * tile - width
    return Grid(batch, height, width, size, tile, kind.across, reach, rows, columns, spare)


def _works(grids: list[Grid], present: list[Tensor], blended: int, kind: TileKind) -> list[TileWork]:
    """Return the work of each grid from the layers that each of its blocks holds. Waits once for a device."""
    pixels = [grid.batch * grid.height * grid.width for grid in grids]
    if kind.windowed:
        layers = present[0].shape[1]
        held = torch.stack([torch.bincount(own.sum(1), minlength=layers + 1) for own in present]).tolist()
        return [TiledOcclusionWork(grid.size, tuple(own), n) for grid, own, n in zip(grids, held, pixels, strict=True)]
    layers, *pairs = torch.stack([present[0].any(0).sum(), *(own.sum() for own in present)]).tolist()
    return [
        kind.work(grid.size, grid.blocks, count, layers, n, blended)
        for grid, count, n in zip(grids, pairs, pixels, strict=True)
    ]


def _cheapest(works: list[TileWork], grids: list[Grid], profile: CostProfile) -> tuple[TileWork, Grid]:
    return min(zip(works, grids, strict=True), key=lambda pair: seconds_of(pair[0], profile))
