"""The tiles of an occlusion-aware rendering: where they lie, which layers their windows hold, which go together.

Tiles differ from those of :mod:`kornia_tidy.render.backends.tile_plan` in that a layer counts wherever it lies in the
window, not only in the tile: light may be hidden by, or come from, what lies beside it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kornia_tidy.render.backends.tile_plan import SAMPLE, Labels
from kornia_tidy.render.borders import next_fast_size

# Sides of transforms; and bytes that the complex planes of a chunk may take, see tiles.py.
SIZES = (16, 24, 32, 36, 48, 64, 72, 96, 128, 144, 192, 256, 288, 384, 512, 768, 1024)
CHUNK_BYTES = {"cpu": 4 << 20}
CHUNK_BYTES_ACCELERATOR = 256 << 20

Corner = tuple[int, int, int]  # image, first row and first column of a window in the padded plane, and of its tile


class Grid(NamedTuple):
    """Square tiles over a batch of images of ``height`` x ``width`` pixels, the last ones reaching beyond."""

    batch: int
    height: int
    width: int
    size: int
    tile: int

    @property
    def rows(self) -> int:
        """Tiles from top to bottom."""
        return math.ceil(self.height / self.tile)

    @property
    def columns(self) -> int:
        """Tiles from left to right."""
        return math.ceil(self.width / self.tile)

    def corner(self, number: int) -> Corner:
        """Return where a tile stands."""
        rest, column = divmod(number, self.columns)
        image, row = divmod(rest, self.rows)
        return image, row * self.tile, column * self.tile


class Chunk(NamedTuple):
    """Tiles that are worked on together, all with n layers in their windows.

    Args:
        corners: where they stand.
        layers: (N, n) their layers from far to near, as indices into :attr:`Plan.present`.
        bounded: nothing of the windows lies in the dark beyond a border of zeros.
        fillers: where in ``corners`` a tile stands only to make a pair and counts for nothing.
    """

    corners: list[Corner]
    layers: Tensor
    bounded: bool
    fillers: list[int]


class Plan(NamedTuple):
    """What is computed for one scene: tiles in chunks, and the (D',) layers that are present at all."""

    grid: Grid
    present: Tensor
    chunks: list[Chunk]


def make_plan(
    lower: Tensor,
    fraction: Tensor | None,
    output: tuple[int, int],
    bank: tuple[int, int, int],
    *,
    sloped: bool,
    dark: bool,
) -> Plan:
    """Choose the tiles for a scene, find the layers of each, and group them into chunks.

    Args:
        lower: (B, H, W) layer of each pixel of the padded image, and
        fraction: share of the next one, or None.
        output: height and width of the image to be made.
        bank: number of layers, channels and the side of the PSFs.
        sloped: a share of zero matters too, for its gradient.
        dark: what lies beyond the border has no weight.
    """
    count, channels, psf_size = bank
    labels = Labels(lower, fraction, sloped).terms()
    grid = choose_grid(labels, output, count, psf_size)
    here = _present(labels, grid, count, 1).cpu()
    used = here.any(0)
    here = here[:, used]
    radius = psf_size // 2 if dark else 0
    corners = [grid.corner(number) for number in range(len(here))]
    bounded = torch.tensor(
        [
            radius <= y <= grid.height + radius - grid.size and radius <= x <= grid.width + radius - grid.size
            for _, y, x in corners
        ]
        if dark
        else [True] * len(here)
    )
    numbers = here.sum(1)
    limit = CHUNK_BYTES.get(lower.device.type, CHUNK_BYTES_ACCELERATOR) // (16 * channels * grid.size**2)
    chunks = []
    for own_bound in (True, False):
        for number in range(1, int(numbers.max()) + 1):
            tiles = ((numbers == number) & (bounded == own_bound)).nonzero().squeeze(-1)
            layers = here[tiles].nonzero()[:, 1].view(-1, number)
            pairs = own_bound and number == 1
            if pairs:
                tiles, layers = _paired(tiles, layers)
            step = max(2, limit // number // 2 * 2)
            for first in range(0, len(tiles), step):
                own = tiles[first : first + step].tolist()
                chunks.append(
                    Chunk(
                        [corners[max(tile, 0)] for tile in own],
                        layers[first : first + step].to(lower.device),
                        own_bound,
                        [place for place, tile in enumerate(own) if tile < 0],
                    )
                )
    return Plan(grid, used.nonzero().squeeze(-1).to(lower.device), chunks)


def choose_grid(labels: list[Tensor], output: tuple[int, int], count: int, psf_size: int) -> Grid:
    """Return the grid with the lowest cost, see :func:`candidates`."""
    return candidates([label[:, ::SAMPLE, ::SAMPLE] for label in labels], output, count, psf_size)[0][1]


def candidates(labels: list[Tensor], output: tuple[int, int], count: int, psf_size: int) -> list[tuple[float, Grid]]:
    """Return grids with their costs, the lowest first. See :func:`windows_cost`.

    Larger tiles waste less on their overlap, smaller ones hold fewer layers. ``labels`` are of every eighth row and
    column of the padded image.
    """
    batch = len(labels[0])
    smallest = 2 * psf_size - 1  # a tile is no shorter than its overlap: a window meets only next neighbours
    sizes = [size for size in SIZES if smallest <= size < 2 * (psf_size - 1 + max(output))]
    grids = [Grid(batch, *output, size, size - psf_size + 1) for size in sizes or [next_fast_size(smallest)]]
    costs = [windows_cost(_present(labels, grid, count, SAMPLE).sum(1), grid.size) for grid in grids]
    return sorted(zip(torch.stack(costs).tolist(), grids, strict=True), key=lambda pair: pair[0])


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


def layers_of_windows(labels: list[Tensor], grid: Grid, count: int) -> Tensor:
    """Return (tiles, count) bool: the layers in each tile's window, looked at on every eighth row and column."""
    return _present([label[:, ::SAMPLE, ::SAMPLE] for label in labels], grid, count, SAMPLE)


def _present(labels: list[Tensor], grid: Grid, count: int, step: int) -> Tensor:
    """Return (tiles, count) bool: the layers in each tile's window. Labels are of every ``step``-th pixel.

    A column belongs to the window of the tile it lies in, and to that of the tile before if it lies near the start.
    """
    batch, _, width = labels[0].shape
    device, own_row = labels[0].device, grid.columns * count
    pixel = step * torch.arange(width, device=device)
    column = (pixel // grid.tile).clamp(max=grid.columns - 1)
    reached = ((pixel - column * grid.tile < grid.size - grid.tile) & (column > 0)).nonzero().squeeze(-1)
    first = torch.arange(batch, device=device)[:, None, None] * (grid.rows * own_row) + column * count
    table = torch.zeros(batch * grid.rows * own_row, dtype=torch.bool, device=device)
    for row in range(grid.rows):  # row by row, in a processor's cache
        top, bottom = row * grid.tile, row * grid.tile + grid.size
        here = table[row * own_row :]
        for label in labels:
            keys = label[:, math.ceil(top / step) : math.ceil(bottom / step)] + first
            here.index_fill_(0, keys.reshape(-1), True)
            here.index_fill_(0, keys[..., reached].sub_(count).reshape(-1), True)
    return table.view(-1, count)


def _paired(tiles: Tensor, layers: Tensor) -> tuple[Tensor, Tensor]:
    """Order tiles of one layer each so that two of a layer stand together; -1 fills up where one is left over."""
    order = layers[:, 0].argsort(stable=True)
    own = layers[order, 0]
    numbers = torch.bincount(own)
    even = numbers + numbers % 2
    shift = (even.cumsum(0) - even) - (numbers.cumsum(0) - numbers)
    slots = torch.arange(len(own)) + shift[own]
    filled = torch.full((int(even.sum()),), -1)
    filled[slots] = tiles[order]
    return filled, torch.arange(len(numbers)).repeat_interleave(even)[:, None]
