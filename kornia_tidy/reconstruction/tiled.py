"""Images of any size through a network, tile by tile, as if they had been seen whole."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any
from weakref import WeakSet

import torch
from torch import Tensor, nn

from kornia_tidy.checks import check_float_tensor, check_positive
from kornia_tidy.reconstruction.head_memory import head_bytes
from kornia_tidy.reconstruction.receptive_field import input_channels, maps_of, receptive_field, total_stride
from kornia_tidy.reconstruction.tile_grid import Span, TileGrid
from kornia_tidy.reconstruction.tile_place import TilePlace

SEAM = 1e-4  # of the largest output: thirty times what float32 was seen to differ by, and below what is seen
_COUNTED_ON = 128  # px; sides of the tile on which memory is counted

_seamless: WeakSet[nn.Module] = WeakSet()


@torch.no_grad()
def reconstruct_tiled(
    head: nn.Module,
    image: Tensor,
    *,
    tile: int | tuple[int, int] | None = None,
    overlap: int | None = None,
    memory_budget: int = 512 << 20,
    out: Tensor | tuple[Tensor, ...] | None = None,
    progress: Callable[[int, int], object] | None = None,
) -> Any:
    r"""Return what a network makes of an image, seen in overlapping tiles of which the middles are kept.

    Tiles are cut on the grid of the network's stride, and what lies within its receptive field of a cut is thrown away:
    what is left does not know of the tile, and equals the result for the whole image up to rounding. The field is
    measured, not assumed, see :func:`~kornia_tidy.reconstruction.receptive_field.receptive_field`; a network whose
    tiles would show is refused.

    Args:
        head: (B, C, H, W) to maps of the same size: a tensor, or a tuple of several. In eval mode, on any device.
        image: (B, C, H, W). May lie on another device than the network, or in a mapped file; tiles are moved, and
            converted to the type of the network's weights, one by one.
        tile: rows and columns of a tile in pixels, its overlap included; one number for both. None: the tile that
            takes the least work within the memory.
        overlap: pixels thrown away at each cut. None: the receptive field, for an exact result. Fewer are faster and
            show; the network is not checked then.
        memory_budget: bytes that the network may take for a tile, beyond its weights, the image and the result.
        out: where to write the maps, such as mapped files: of the output's shape, or a tuple of these. None: new
            tensors on the image's device, in the network's type.
        progress: called after each tile with the numbers of tiles done and of all. What it raises ends the work.

    Returns:
        What the network returns. An image that fits the memory is seen whole.

    Raises:
        TypeError: if the image is not a floating-point tensor.
        ValueError: if the network cannot be tiled, a tile is not larger than its overlap, or no tile fits the memory.

    Convention:
        Gradients are not computed.

    Example:
        >>> head = nn.Sequential(nn.Conv2d(3, 8, 5, padding=2), nn.ReLU(), nn.Conv2d(8, 1, 3, padding=1)).eval()
        >>> image = torch.rand(1, 3, 50, 70)
        >>> tiled = reconstruct_tiled(head, image, tile=32)
        >>> with torch.no_grad():
        ...     bool((tiled - head(image)).abs().max() < 1e-6)
        True
    """
    check_float_tensor("image", image, 4, "(B, C, H, W)")
    check_positive("memory_budget", memory_budget, "bytes")
    if overlap is not None and overlap < 0:
        raise ValueError(f"overlap must be 0 pixels or more, got {overlap}")
    if overlap is None:
        _check_seamless(head)
        overlap = receptive_field(head)
    grid = TileGrid((image.shape[-2], image.shape[-1]), total_stride(head), overlap)
    like = next(head.parameters(), image)
    if tile is None:
        sides = _sides_that_fit(head, grid, like.new_empty((*image.shape[:2], 0, 0)), memory_budget)
    else:
        sides = grid.sides_within((tile, tile) if isinstance(tile, int) else tile)
    return _run(head, image, grid, sides, like, out, progress)


def _run(
    head: nn.Module,
    image: Tensor,
    grid: TileGrid,
    sides: tuple[int, int],
    like: Tensor,
    out: Tensor | tuple[Tensor, ...] | None = None,
    progress: Callable[[int, int], object] | None = None,
) -> Any:
    tiles = grid.tiles(sides)
    result: Any = out
    for done, place in enumerate(tiles):
        output = _see(head, grid.cut(image, place, sides).to(like), grid, place)
        if result is None:
            result = _blank(output, image)
        for part, whole in zip(maps_of(output), maps_of(result), strict=True):
            grid.keep(part, whole, place)
        del output, part, whole  # or the next tile would be seen beside it
        if progress is not None:
            progress(done + 1, len(tiles))
    return result


def _see(head: nn.Module, part: Tensor, grid: TileGrid, place: tuple[Span, Span]) -> Any:
    """What the network makes of one tile. Channels last takes less memory and, on a CPU, up to 0.6 of the time."""
    corner = (place[0].start, place[1].start)
    with TilePlace((part.shape[-2], part.shape[-1]), corner, grid.whole):
        return head(part.contiguous(memory_format=torch.channels_last))


def _blank(output: Any, image: Tensor) -> Any:
    """Maps of the whole image, in the form of a tile's."""
    maps = [part.new_empty((*part.shape[:2], *image.shape[-2:]), device=image.device) for part in maps_of(output)]
    if isinstance(output, Tensor):
        return maps[0]
    return type(output)(*maps) if hasattr(output, "_fields") else tuple(maps)


def _sides_that_fit(head: nn.Module, grid: TileGrid, like: Tensor, memory_budget: int) -> tuple[int, int]:
    """The tile with the least to compute within the memory, whose use grows with the pixels of a tile."""
    side = -(-_COUNTED_ON // grid.stride) * grid.stride
    each = head_bytes(head, like.new_zeros(*like.shape[:2], side, side)) / side**2
    sides = grid.cheapest_sides(int(memory_budget / each))
    if sides is None:
        rows, columns = grid.smallest_sides()
        needed = each * rows * columns / 2**20
        raise ValueError(
            f"the smallest tile of this head, {rows} x {columns} pixels, takes {needed:.0f} MiB, "
            f"memory_budget allows {memory_budget / 2**20:.0f} MiB: allow more, or give an overlap below "
            f"{grid.margin} pixels for a result that is not exact"
        )
    return sides


def _check_seamless(head: nn.Module) -> None:
    """Raise ``ValueError`` unless two tiles of noise are the whole, on sides that are no multiples of the stride.

    Finds what no receptive field tells: pixels that are treated by their place, or borders continued in another way.
    """
    if head in _seamless:
        return
    stride, reach = total_stride(head), receptive_field(head)
    copied = copy.deepcopy(head).float().cpu()
    margin = -(-reach // stride) * stride
    long, across = 2 * margin + 3 * stride - stride // 2, stride + stride // 2 + 7
    for size in ((long, across), (across, long)):
        noise = torch.Generator().manual_seed(0)
        image = torch.rand(1, input_channels(head), *size, generator=noise)
        grid = TileGrid(size, stride, reach)
        tiled = _run(copied, image, grid, grid.smallest_sides(), image)
        for part, whole in zip(maps_of(tiled), maps_of(copied(image)), strict=True):
            if not bool((part - whole).abs().max() <= SEAM * whole.abs().max().clamp(min=1)):
                raise ValueError(
                    f"the head cannot be tiled exactly: its output depends on where a pixel lies in the image, or its "
                    f"borders are not those of a ReconstructionHead (total stride {stride}); give an overlap to tile "
                    f"it approximately"
                )
    _seamless.add(head)
