"""Tiles: how a plane is cut into pieces that each meet only the layers they contain.

Seen through PSFs of P pixels, a tile needs a window of ``size = tile + P - 1`` pixels a side, which is transformed.
Larger tiles waste less on their overlap, smaller ones hold fewer layers: the grid with the lowest cost is chosen from a
sample of the scene's labels. Gather and scatter work on blocks of two tiles (:data:`BLOCKS`), occlusion on single
windows (:data:`WINDOWS`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from kornia_tidy.render.borders import next_fast_size
from kornia_tidy.render.layers import SAMPLE, Labels

TILE_FACTOR = 1.1  # time of all windows over their cost in the choice of a grid
PIXEL_NANOSECONDS = 8.5  # of a pixel and each layer that it takes light from
SHARED = 0.5  # of the work by transforms that threads share


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
    """

    sizes: tuple[int, ...]
    candidates: int
    across: int
    windowed: bool
    chunk_bytes: int
    accelerator_bytes: int = 256 << 20


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


def cheapest_grid(labels: Labels, layers: int, psf_size: int, kind: TileKind) -> tuple[float, Grid]:
    """Return the lowest cost in nanoseconds a channel, and the grid that has it.

    The layers of each candidate's blocks are found on every eighth row and column.

    Args:
        labels: of all pixels of the scene.
        layers: number of layers D.
        psf_size: side P of the PSFs.
        kind: of the tiles.
    """
    grids = candidates(tuple(labels.layer_index.shape), psf_size, kind)
    sample = labels.every(SAMPLE)
    costs = _costs(grids, [grid.present(sample, layers, SAMPLE).sum(1) for grid in grids], kind)
    return min(zip(costs, grids, strict=True), key=lambda pair: pair[0])


@lru_cache(maxsize=256)
def least_cost(shape: tuple[int, ...], psf_size: int, kind: TileKind) -> float:
    """Return the cost of labels of a shape with one layer in each block, in nanoseconds a channel."""
    grids = candidates(shape, psf_size, kind)
    held = [torch.ones(grid.blocks, dtype=torch.int64) for grid in grids]
    return min(_costs(grids, held, kind))


def candidates(shape: tuple[int, ...], psf_size: int, kind: TileKind = BLOCKS) -> list[Grid]:
    """Return the grids to choose from, for labels of a shape."""
    batch, height, width = shape
    if kind.windowed:  # labels are those of the windows
        height, width = height - psf_size + 1, width - psf_size + 1
    smallest = 2 * psf_size - 1  # a tile is no shorter than its overlap: only next neighbours overlap
    whole = psf_size - 1 + max(height, math.ceil(width / kind.across))
    sizes = [size for size in kind.sizes if smallest <= size < 2 * whole][: kind.candidates]
    return [_grid(batch, height, width, size, psf_size, kind) for size in sizes or [next_fast_size(smallest)]]


def _grid(batch: int, height: int, width: int, size: int, psf_size: int, kind: TileKind) -> Grid:
    """Return the grid of the fewest blocks; where overlap is free, in tiles no larger than needed."""
    tile, reach = size - psf_size + 1, psf_size - 1 if kind.windowed else 0
    rows, columns = math.ceil(height / tile), math.ceil(width / (kind.across * tile))
    if not kind.windowed:
        tile = min(tile, max(math.ceil(height / rows), math.ceil(width / (kind.across * columns)), (size + 1) // 2))
        rows, columns = math.ceil(height / tile), math.ceil(width / (kind.across * tile))
    return Grid(batch, height, width, size, tile, kind.across, reach, rows, columns)


def _costs(grids: list[Grid], held: list[Tensor], kind: TileKind) -> list[float]:
    """Return the cost of each grid from the number of layers that each of its blocks holds. Waits once for a device."""
    if kind.windowed:
        return torch.stack([windows_cost(own, grid.size) for grid, own in zip(grids, held, strict=True)]).tolist()
    pairs = torch.stack([own.sum() for own in held]).tolist()
    return [tile_cost(grid.size, len(own), count) for grid, own, count in zip(grids, held, pairs, strict=True)]


def transforms_seconds(nanoseconds: float) -> float:
    """Return the time in seconds of work by transforms that takes some nanoseconds on one core.

    Of such work torch's threads share :data:`SHARED`.
    """
    return nanoseconds * (1 - SHARED + SHARED / torch.get_num_threads()) * 1e-9


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


def windows_cost(layers: Tensor, size: int) -> Tensor:
    r"""Return the time that windows take in nanoseconds a channel, on a core of a 2.5 GHz Xeon.

    .. math:: n^2 \left( 0.6 + \frac{n}{130} \right) \sum_w \max(6, 17 d_w + 7 (d_w - 2)) + 15000 \sum_w d_w

    for windows of n x n samples, of which the w-th holds :math:`d_w` layers: a window of a single layer is computed in
    float32; larger windows leave the cache; and each layer is called for. Fitted to 48 to 288 samples.

    Args:
        layers: d, the number of layers of each window.
        size: n.

    Example:
        >>> f"{float(windows_cost(torch.tensor([1, 2, 3]), 64)) * 1e-6:.2f} ms"
        '0.53 ms'
    """
    each = torch.where(layers < 2, 6, 17 * layers + 7 * (layers - 2))
    return each.sum() * (size**2 * (0.6 + size / 130)) + 15000 * layers.sum()
