"""Tiled reconstruction of images of any size, with the result of the whole image."""

from __future__ import annotations

import copy
from collections.abc import Callable
from contextlib import nullcontext
from typing import Any
from weakref import WeakKeyDictionary, WeakSet

import torch
from torch import Tensor, nn

from kornia_tidy.checks import check_float_tensor, check_positive
from kornia_tidy.reconstruction.freed_memory import release_freed_memory
from kornia_tidy.reconstruction.head import sharing_weights
from kornia_tidy.reconstruction.head_memory import head_bytes
from kornia_tidy.reconstruction.receptive_field import (
    check_eval,
    input_channels,
    maps_of,
    receptive_field,
    take_receptive_field,
    total_stride,
)
from kornia_tidy.reconstruction.ruled_closed_form import RuledClosedForm
from kornia_tidy.reconstruction.tile_grid import Span, TileGrid
from kornia_tidy.reconstruction.tile_place import TilePlace
from kornia_tidy.reconstruction.whole_picture import closed_forms_without_statistics, whole_picture

# Shipped networks see 220 to 450 px far, but heed little beyond 100: tiles cut at 144 px differ from the whole by at
# most 2e-4 of full scale (joint-uncertain, twelve draws of noise). At 128 px it is 6e-4, and was 1.2e-3 in another
# draw; at 160 px 1.5e-4, with a third more computation.
OVERLAP = 144
SEAM = 1e-4  # largest difference, relative to the largest output
_COUNTED_ON = 128  # px; sides of the tile on which memory is counted

_seamless: WeakSet[nn.Module] = WeakSet()
_counted: WeakKeyDictionary[nn.Module, dict[Any, float]] = WeakKeyDictionary()  # bytes a pixel by kind of image


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
    r"""Apply a network to an image in overlapping tiles and join their middles.

    Tiles are cut on the grid of the network's stride, and outputs within its receptive field of a cut are discarded.
    The others equal the result for the whole image up to rounding. The receptive field is measured, see
    :func:`~kornia_tidy.reconstruction.receptive_field.receptive_field`. Networks for which tiles differ from the whole
    are refused. An image that fits the memory is one tile, for which nothing is measured and any network is taken.

    Args:
        head: network in eval mode, on any device, from (B, C, H, W) to a map of the same size or a tuple of maps.
        image: (B, C, H, W). It may be on another device than the network, or in a mapped file; tiles are moved, and
            converted to the data type of the network's weights, one by one.
        tile: rows and columns of a tile in pixels, including its overlap; one number for both. None: the tile with the
            least computation within the memory.
        overlap: pixels discarded at each cut. None: the receptive field, for an exact result. Fewer are faster, but
            leave visible seams; the network is not checked then.
        memory_budget: bytes that the network may use for a tile, beyond its weights, the image and the result.
        out: tensors for the maps, such as mapped files, in the form of the output. None: new tensors on the device of
            the image, in the network's data type.
        progress: called after each tile with the numbers of finished and of all tiles. Its exceptions end the work.

    Returns:
        The network's output for the whole image.

    Raises:
        TypeError: if the image is not a floating-point tensor.
        ValueError: if the network is in training mode or cannot be tiled, a tile is not larger than its overlap, or no
            tile fits the memory.

    Convention:
        Gradients are not computed. Stray light that a network takes away follows from the mean light of the whole
        image, see :func:`~kornia_tidy.reconstruction.whole_picture.whole_picture`.

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
    if untold := closed_forms_without_statistics(head):
        told = whole_picture(head, image, encoded=untold[0].encoded)
    else:
        told = nullcontext()
    with told:
        return _in_tiles(head, image, tile, overlap, memory_budget, out, progress)


def _in_tiles(
    head: nn.Module,
    image: Tensor,
    tile: int | tuple[int, int] | None,
    overlap: int | None,
    memory_budget: int,
    out: Tensor | tuple[Tensor, ...] | None,
    progress: Callable[[int, int], object] | None,
) -> Any:
    check_eval(head)
    like = next(head.parameters(), image)
    if tile is None and (whole := one_tile(head, image, memory_budget)) is not None:
        return _run(head, image, whole, whole.whole, like, out, progress)
    if overlap is None:
        check_seamless(head)
        overlap = receptive_field(head)
    grid = TileGrid((image.shape[-2], image.shape[-1]), total_stride(head), overlap)
    if tile is None:
        sides = _sides_that_fit(head, grid, image, memory_budget)
    else:
        sides = grid.sides_within((tile, tile) if isinstance(tile, int) else tile)
    return _run(head, image, grid, sides, like, out, progress)


def one_tile(head: nn.Module, image: Tensor, memory_budget: int) -> TileGrid | None:
    """Return the grid of an image that a network may see as one tile within the memory; None if it must be cut.

    Args:
        head: network in eval mode.
        image: (B, C, H, W).
        memory_budget: bytes that the network may use, beyond its weights, the image and the result.

    Example:
        >>> image = torch.rand(1, 3, 64, 64)
        >>> one_tile(nn.Conv2d(3, 8, 1), image, 1 << 20).whole, one_tile(nn.Conv2d(3, 8, 1), image, 1 << 10)
        ((64, 64), None)
    """
    grid = TileGrid((image.shape[-2], image.shape[-1]), total_stride(head), overlap=0)
    return grid if _bytes_a_pixel(head, image) * grid.whole[0] * grid.whole[1] <= memory_budget else None


def shared_copy(head: nn.Module) -> nn.Module:
    """Return a copy of a network that shares its weights, for another picture at the same time.

    The noise of a picture and its stray light are kept in the closed form of a network, so that two threads need two
    copies. Measurements for tiles are not repeated.

    Args:
        head: the network.

    Example:
        >>> head = nn.Conv2d(3, 3, 1)
        >>> copied = shared_copy(head)
        >>> copied is head, copied.weight is head.weight
        (False, True)
    """
    copied = sharing_weights(head)
    _counted[copied] = _counted.setdefault(head, {})
    if head in _seamless:
        _seamless.add(copied)
        take_receptive_field(copied, head)
    return copied


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
        del output, part, whole  # else this tile's output would be held beside the next one's
        if progress is not None:
            progress(done + 1, len(tiles))
    if len(tiles) > 1:
        release_freed_memory()
    return result


def _see(head: nn.Module, part: Tensor, grid: TileGrid, place: tuple[Span, Span]) -> Any:
    """Return the network's output for one tile, in channels-last format: less memory, and on a CPU less time (0.6)."""
    corner = (place[0].start, place[1].start)
    with TilePlace((part.shape[-2], part.shape[-1]), corner, grid.whole):
        return head(part.contiguous(memory_format=torch.channels_last))


def _blank(output: Any, image: Tensor) -> Any:
    """Return empty maps of the whole image, in the form of a tile's output."""
    maps = [part.new_empty((*part.shape[:2], *image.shape[-2:]), device=image.device) for part in maps_of(output)]
    if isinstance(output, Tensor):
        return maps[0]
    return type(output)(*maps) if hasattr(output, "_fields") else tuple(maps)


def _bytes_a_pixel(head: nn.Module, image: Tensor) -> float:
    """Return the memory of a network for an image, which is linear in its pixels; counted once for a network."""
    like = next(head.parameters(), image)
    kind = (*image.shape[:2], like.dtype, like.device)
    counted = _counted.setdefault(head, {})
    if kind not in counted:
        stride = total_stride(head)
        side = -(-_COUNTED_ON // stride) * stride
        part = like.new_zeros(*image.shape[:2], side, side).contiguous(memory_format=torch.channels_last)
        if any(isinstance(module, RuledClosedForm) for module in head.modules()):
            head(part[..., :stride, :stride])  # finds the settings of the picture, whose memory is not a tile's
        counted[kind] = head_bytes(head, part) / side**2
    return counted[kind]


def _sides_that_fit(head: nn.Module, grid: TileGrid, image: Tensor, memory_budget: int) -> tuple[int, int]:
    """Return the sides of the tile with the least computation within the memory."""
    each = _bytes_a_pixel(head, image)
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


@torch.no_grad()
def check_seamless(head: nn.Module) -> None:
    """Raise ``ValueError`` unless tiles of a noise image give the result of the whole image.

    It is done once for a network. The sides of the image are no multiples of the stride. This finds dependence on
    position and other paddings, which the receptive field does not show. It is computed in float64: networks that
    decide between depths round to 3e-4 in float32.
    """
    if head in _seamless:
        return
    stride, reach = total_stride(head), receptive_field(head)
    copied = copy.deepcopy(head).double().cpu()
    margin = -(-reach // stride) * stride
    long, across = 2 * margin + 3 * stride - stride // 2, stride + stride // 2 + 7
    for size in ((long, across), (across, long)):
        noise = torch.Generator().manual_seed(0)
        image = torch.rand(1, input_channels(head), *size, generator=noise, dtype=torch.float64)
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
