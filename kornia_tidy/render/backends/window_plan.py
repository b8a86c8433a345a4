"""The plan of occlusion by tiles: which layers each tile's window holds, and which tiles are worked on together."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kornia_tidy.render.backends.tile_plan import Grid, TileKind
from kornia_tidy.render.scene import Labels

Corner = tuple[int, int, int]  # image, first row and first column of a window in the padded plane, and of its tile


class WindowChunk(NamedTuple):
    """Tiles that are worked on together, all with n layers in their windows.

    Args:
        corners: where they stand.
        layers: (N, n) their layers from far to near, as indices into :attr:`WindowPlan.present`.
        bounded: nothing of the windows lies in the dark beyond a border of zeros.
        fillers: where in ``corners`` a tile stands only to make a pair and counts for nothing.
    """

    corners: list[Corner]
    layers: Tensor
    bounded: bool
    fillers: list[int]

    @property
    def single_layer(self) -> bool:
        """Whether each window is all of one layer, and tiles stand in pairs."""
        return self.bounded and self.layers.shape[1] == 1


class WindowPlan(NamedTuple):
    """The tiles of one scene in chunks, and the (D',) layers that are present in it."""

    grid: Grid
    present: Tensor
    chunks: list[WindowChunk]


def plan_windows(labels: Labels, layers: int, channels: int, grid: Grid, kind: TileKind, *, dark: bool) -> WindowPlan:
    """Find the layers of each window of a grid, and group the tiles into chunks.

    Args:
        labels: the layers of the padded image's pixels.
        layers: number of layers D.
        channels: of the image.
        grid: of the tiles.
        kind: of the tiles.
        dark: what lies beyond the border has no weight.
    """
    device = labels.layer_index.device
    here = grid.present(labels, layers).cpu()
    used = here.any(0)
    here = here[:, used]
    corners = [grid.corner(number) for number in range(len(here))]
    bounded = torch.tensor([not dark or _within(corner, grid) for corner in corners])
    numbers = here.sum(1)
    limit = kind.chunk_bytes if device.type == "cpu" else kind.accelerator_bytes
    limit //= 16 * channels * grid.size**2
    chunks = []
    for own_bound in (True, False):
        for number in range(1, int(numbers.max()) + 1):
            tiles = ((numbers == number) & (bounded == own_bound)).nonzero().squeeze(-1)
            held = here[tiles].nonzero()[:, 1].view(-1, number)
            if own_bound and number == 1:
                tiles, held = _paired(tiles, held)
            step = max(2, limit // number // 2 * 2)
            for first in range(0, len(tiles), step):
                own = tiles[first : first + step].tolist()
                chunks.append(
                    WindowChunk(
                        [corners[max(tile, 0)] for tile in own],
                        held[first : first + step].to(device),
                        own_bound,
                        [place for place, tile in enumerate(own) if tile < 0],
                    )
                )
    return WindowPlan(grid, used.nonzero().squeeze(-1).to(device), chunks)


def _within(corner: Corner, grid: Grid) -> bool:
    """Whether a window lies in the image, without its border of the PSFs' radius."""
    _, y, x = corner
    radius = grid.reach // 2
    bottom, right = grid.height + radius - grid.size, grid.width + radius - grid.size
    return radius <= y <= bottom and radius <= x <= right


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
