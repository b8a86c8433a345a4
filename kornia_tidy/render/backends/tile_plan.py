"""Tiles: how a plane is cut into pieces that each meet only the layers they contain.

Seen through PSFs of P pixels, a tile needs a window of ``size = tile + P - 1`` pixels a side, which is transformed.
Larger tiles waste less on their overlap, smaller ones hold fewer layers: windows have some 2.5 P pixels a side. Gather
and scatter work on blocks of two tiles (:data:`BLOCKS`), occlusion on single windows (:data:`WINDOWS`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from kornia_tidy.render.borders import next_fast_size
from kornia_tidy.render.scene import Labels


@dataclass(frozen=True)
class TileKind:
    """Sizes and limits of the tiles of gather and scatter, or of occlusion.

    Args:
        sizes: sides of windows with fast transforms, ascending, in samples.
        across: tiles that stand side by side in a block.
        windowed: a layer counts wherever it lies in the window, not only in the tile.
        chunk_bytes: that the planes of a chunk may take on a processor, near its cache (see allocator.py), and
        accelerator_bytes: on an accelerator, enough to keep it busy.
    """

    sizes: tuple[int, ...]
    across: int
    windowed: bool
    chunk_bytes: int
    accelerator_bytes: int = 256 << 20


# A block is two tiles: the left window is the real and the right one the imaginary part of a complex plane, so that one
# transform serves both. Bytes are those of one channel. Smaller windows are slower by what each call takes.
BLOCKS = TileKind(
    sizes=(
        *(48, 64, 72, 80, 96, 112, 128, 144, 160, 192, 200, 216, 240, 256, 288, 320, 384, 512, 576, 768, 1024),
        *(1536, 2048),
    ),
    across=2,
    windowed=False,
    chunk_bytes=5 << 20,
)
# With occlusion the neighbours of a tile emit and hide light in it. Bytes are those of all channels.
WINDOWS = TileKind(
    sizes=(32, 48, 64, 72, 96, 128, 144, 192, 256, 288, 384, 512, 768, 1024),
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

    @classmethod
    def of(cls, shape: tuple[int, ...], psf_size: int, size: int, kind: TileKind | None = None) -> Grid:
        """Return the grid of the fewest blocks with windows of a size; where overlap is free, of no larger tiles.

        Args:
            shape: of the output, (B, H, W).
            psf_size: side P of the PSFs.
            size: side of the windows in samples.
            kind: of the tiles. Default: single tiles with the layers in them.
        """
        batch, height, width = shape
        across, windowed = (1, False) if kind is None else (kind.across, kind.windowed)
        tile, reach = size - psf_size + 1, psf_size - 1 if windowed else 0
        rows, columns = math.ceil(height / tile), math.ceil(width / (across * tile))
        if not windowed:
            tile = min(tile, max(math.ceil(height / rows), math.ceil(width / (across * columns)), (size + 1) // 2))
            rows, columns = math.ceil(height / tile), math.ceil(width / (across * tile))
        return cls(batch, height, width, size, tile, across, reach, rows, columns)

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


def tile_grid(shape: tuple[int, ...], psf_size: int, kind: TileKind) -> Grid:
    """Return the tiles for labels of a shape (B, H, W), in windows of some 2.5 P pixels and no larger than needed.

    Args:
        shape: of the labels: of the pixels, for a windowed kind of their windows.
        psf_size: side P of the PSFs.
        kind: of the tiles.

    Example:
        >>> tile_grid((1, 500, 600), 23, BLOCKS).size, tile_grid((1, 20, 30), 23, BLOCKS).size
        (64, 48)
    """
    batch, height, width = shape
    if kind.windowed:
        height, width = height - psf_size + 1, width - psf_size + 1
    whole = psf_size - 1 + max(height, math.ceil(width / kind.across))
    # A tile is no shorter than its overlap: only next neighbours overlap.
    wanted = max(2 * psf_size - 1, min(math.ceil(2.5 * psf_size), whole))
    size = next((size for size in kind.sizes if size >= wanted), next_fast_size(wanted))
    return Grid.of((batch, height, width), psf_size, size, kind)
