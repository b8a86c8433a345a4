"""The workspace of gather and scatter by tiles: the four steps that forward and backward passes are made of.

Overlap-save for gather, overlap-add for scatter. Each is the other's transpose, so both are made of the same steps: cut
windows out of a plane, add windows to a plane, scatter pixels to the planes of their layers, gather pixels from the
planes of their layers. The planes of one chunk of tiles exist at a time, in one channel.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from kornia_tidy.render.backends.block_plan import BlockPlan, Chunk


class Offsets(NamedTuple):
    """Offsets of pixels in the planes of their layers, in floats; and in those of the next layers, with its weight."""

    below: Tensor
    above: tuple[Tensor, Tensor] | None


@dataclass(eq=False)
class TileWorkspace:
    """The steps of one pass over a plan, for one channel of one chunk each, in memory that all of them use again.

    Fetching memory from the system takes as long as the transforms in it.

    Args:
        plan: what to compute.
        psfs: (D, C, P, P).
    """

    plan: BlockPlan
    psfs: Tensor
    _memory: dict[tuple[str, torch.dtype], Tensor] = field(default_factory=dict)

    @cached_property
    def spectra(self) -> Tensor:
        """(C, D', size, size) spectra of the PSFs of the layers that are present."""
        psfs = self.psfs.transpose(0, 1).index_select(1, self.plan.present)
        return torch.fft.fft2(psfs, s=(self.plan.grid.size, self.plan.grid.size))

    @cached_property
    def conjugate(self) -> Tensor:
        """Spectra of the PSFs flipped by 180 degrees: correlation is the transpose of convolution."""
        return torch.conj_physical(self.spectra)

    def no_spectra(self) -> Tensor:
        """Return zeros of the shape of :attr:`spectra`."""
        shape = (self.psfs.shape[1], len(self.plan.present), self.plan.grid.size, self.plan.grid.size)
        return self.psfs.new_zeros(shape, dtype=self.psfs.dtype.to_complex())

    def _buffer(self, name: str, shape: Sequence[int], dtype: torch.dtype | None = None) -> Tensor:
        """Return memory by name, with whatever was left in it."""
        count, key = math.prod(shape), (name, dtype or self.psfs.dtype)
        if key not in self._memory or len(self._memory[key]) < count:
            self._memory[key] = torch.empty(count, dtype=key[1], device=self.psfs.device)
        return self._memory[key][:count].view(*shape)

    def windows(self, plane: Tensor, chunk: Chunk) -> Tensor:
        """Cut a chunk's windows out of a (B, H', W') plane, black beyond its ends: (blocks, size, size) complex."""
        size, tile = self.plan.grid.size, self.plan.grid.tile
        images, rows, columns = chunk.extent
        height, width = (rows - 1) * tile + size, (2 * columns - 1) * tile + size
        _, y, x = chunk.pixels
        part = plane[chunk.batch, y.start : y.start + height, x.start : x.start + width]
        if part.shape[1:] != (height, width):
            whole = self._buffer("part", (images, height, width))
            whole[:, part.shape[1] :] = 0
            whole[:, : part.shape[1], part.shape[2] :] = 0
            whole[:, : part.shape[1], : part.shape[2]] = part
            part = whole
        tiles = part.unfold(1, size, tile).unfold(2, size, tile)
        cut = self._buffer("windows", (*chunk.extent, size, size), self.psfs.dtype.to_complex())
        return torch.complex(tiles[:, :, 0::2], tiles[:, :, 1::2], out=cut).flatten(0, 2)

    def add_windows(self, plane: Tensor, windows: Tensor, chunk: Chunk) -> None:
        """Add a chunk's windows to a plane where :meth:`windows` cuts them: its transpose."""
        size, tile = self.plan.grid.size, self.plan.grid.tile
        rows, columns = chunk.extent[1:]
        halves = torch.view_as_real(windows).unflatten(0, chunk.extent).movedim(-1, 0)
        for half, light in enumerate(halves):
            left = chunk.pixels[2].start + half * tile
            across = plane[chunk.batch, :, left : left + (columns - 1) * 2 * tile + size]
            # Of every second tile, windows overlap with the row above and below only, by less than a tile: first the
            # tiles, then the overhang, so that no pixel is met twice in one addition.
            for start, stop in ((0, tile), (tile, size)):
                if start < stop:
                    top = chunk.pixels[1].start + start
                    down = across[:, top : top + (rows - 1) * tile + stop - start]
                    down.unfold(1, stop - start, tile).unfold(2, size, 2 * tile).add_(light[..., start:stop, :])

    def tiled_plane(self, plane: Tensor) -> Tensor:
        """Return a black plane that holds the windows of all blocks."""
        grid = self.plan.grid
        overlap = grid.size - grid.tile
        return plane.new_zeros(
            *plane.shape[:2], grid.rows * grid.tile + overlap, grid.columns * grid.across * grid.tile + overlap
        )

    def blur(self, light: Tensor, spectra: Tensor, chunk: Chunk) -> Tensor:
        """Return each pair's light times the spectrum of its layer, (pairs, size, size)."""
        pairs = self._buffer("pairs", (len(chunk.layer), *light.shape[1:]), self.psfs.dtype.to_complex())
        if not self.plan.by_slices:
            return torch.index_select(spectra, 0, chunk.layer, out=pairs).mul_(light.index_select(0, chunk.block))
        for run in chunk.runs:
            torch.mul(spectra[run.layers], light[run.block], out=pairs[run.pairs])
        return pairs

    def sum_layers(self, own: Tensor, spectra: Tensor, chunk: Chunk) -> Tensor:
        """Return each block's sum over its layers of their light times their spectrum. Writes over ``own``."""
        total = self._buffer("windows", (len(chunk.counts), *own.shape[1:]), self.psfs.dtype.to_complex())
        if not self.plan.by_slices:
            pairs = self._buffer("pairs", own.shape, own.dtype)
            own.mul_(torch.index_select(spectra, 0, chunk.layer, out=pairs))
            return total.zero_().index_add_(0, chunk.block, own)
        for run in chunk.runs:
            own[run.pairs].mul_(spectra[run.layers])
        for block, pairs in zip(total, own.split(chunk.counts), strict=True):
            torch.sum(pairs, 0, out=block)
        return total

    def offsets(self, chunk: Chunk) -> Offsets:
        """Find each of a chunk's pixels in the planes of its layers."""
        images, y, x = chunk.pixels
        number = self.plan.number[: images.stop - images.start, : y.stop - y.start, x]
        # Blocks are counted from the first of the chunk's first row.
        start = self.plan.start[(images.start * self.plan.grid.rows + chunk.rows.start) * self.plan.grid.columns :]
        key = self._buffer("key", number.shape, torch.int64)
        found = []
        for layer in self.plan.labels.terms(images, y, x):
            torch.add(layer, number, out=key)
            offset = self._buffer(f"offset {len(found)}", (key.numel(),), torch.int64)
            torch.index_select(start.view(-1), 0, key.view(-1), out=offset)
            found.append(offset.view(key.shape).add_(self.plan.inside[: y.stop - y.start, x]))
        weight = self.plan.labels.layer_weight
        return Offsets(found[0], None if weight is None else (found[1], weight[images, y, x]))

    def gather_from_planes(
        self, blended: Tensor, planes: Tensor, offsets: Offsets, *, weight_gradient: bool = False
    ) -> None:
        """Write each pixel's mean over its layers into ``blended``, or its derivative to the next layer's weight."""
        floats = torch.view_as_real(planes)
        torch.take(floats, offsets.below, out=blended)
        if offsets.above is not None:
            above, weight = offsets.above
            nearer = torch.take(floats, above, out=self._buffer("above", blended.shape))
            blended.copy_(nearer - blended) if weight_gradient else blended.lerp_(nearer, weight)

    def scatter_to_planes(self, light: Tensor, offsets: Offsets, chunk: Chunk) -> Tensor:
        """Split each pixel over the planes of its layers, the transpose of gathering: (pairs, size, size) complex."""
        size = self.plan.grid.size
        planes = self._buffer("pairs", (len(chunk.layer), size, size), self.psfs.dtype.to_complex()).zero_()
        floats = torch.view_as_real(planes).view(-1)
        if offsets.above is not None:
            above, weight = offsets.above
            weighted = light * weight
            floats.index_put_((above,), weighted)  # put_ is refused where determinism is asked for
            light = torch.where(offsets.below == above, light, light - weighted)
        floats.index_put_((offsets.below,), light)
        return planes

    def correlate(self, sums: Tensor, light: Tensor, own: Tensor, chunk: Chunk) -> None:
        """Add the correlation of the layers' own pixels with the light of their windows to the spectra of a channel."""
        light = torch.conj_physical(light)
        if not self.plan.by_slices:
            sums.index_add_(0, chunk.layer, light.index_select(0, chunk.block).mul_(own))
            return
        for run in chunk.runs:
            sums[run.layers].addcmul_(light[run.block], own[run.pairs])

    def psfs_of(self, spectra: Tensor) -> Tensor:
        """Return PSFs (D, C, P, P) of spectra of the layers that are present; the others are zero.

        Left and right tiles correlate with themselves in the real part, with each other in the imaginary part.
        """
        side, psfs = self.psfs.shape[-1], torch.zeros_like(self.psfs)
        psfs[self.plan.present] = torch.fft.ifft2(spectra).real[..., :side, :side].transpose(0, 1)
        return psfs
