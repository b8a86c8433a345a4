"""Gather and scatter by tiles: overlap-save for gather, overlap-add for scatter, each the other's transpose."""

from __future__ import annotations

import math
from functools import cached_property
from itertools import product

import torch
from torch import Tensor

from kornia_tidy.render.backends.tiles import Chunk, Plan, part_of, windows
from kornia_tidy.render.scene import LayeredScene


class TileSums:
    """See :class:`kornia_tidy.render.backends.layer_sums.LayerSums`. Spectra are computed once for all three sums.

    Args:
        scene: to be rendered.
        plan: of its pairs.
        together: channels that are worked on at a time.
    """

    def __init__(self, scene: LayeredScene, plan: Plan, together: int) -> None:
        self.labels, self.psfs, self.plan, self.grid = scene.labels, scene.psfs.detach(), plan, plan.grid
        self.inner = 0 if scene.compositing == "scatter" else self.grid.lost  # where a tile starts in its window
        self.together, channels = together, self.psfs.shape[1]
        self.channels = [slice(first, first + self.together) for first in range(0, channels, self.together)]
        psfs = self.psfs.index_select(0, self.plan.layers)
        self.spectra = [torch.fft.fft2(psfs[:, part], s=self.grid.size) for part in self.channels]

    @cached_property
    def conjugate(self) -> list[Tensor]:
        """Spectra of the PSFs flipped by 180 degrees: correlation is the transpose of convolution."""
        return [spectra.conj().resolve_conj() for spectra in self.spectra]

    def gather(self, plane: Tensor, *, correlate: bool = False, weight_gradient: bool = False) -> Tensor:
        """Return the gathered light (B, C, h, w) of a plane."""
        blended = plane.new_empty(*plane.shape[:2], *self.grid.shape)
        for chunk in self.plan.chunks:
            (images, y, x), offsets = chunk.pixels, self._offsets(chunk)
            for part, spectra in zip(self.channels, self.conjugate if correlate else self.spectra, strict=True):
                light = self._windows(plane[:, part], chunk)
                blurred = light.new_empty(len(chunk.layer), *light.shape[1:])
                for blocks, pairs, layers in chunk.runs:
                    psfs = spectra[layers]
                    torch.mul(light[blocks, None], psfs, out=blurred[pairs].unflatten(0, (-1, len(psfs))))
                floats = torch.view_as_real(torch.fft.ifft2(blurred))
                below, *above = (floats.take(offset) for offset in offsets)
                for nearer in above:
                    below = nearer - below if weight_gradient else below.lerp_(nearer, self._weight(chunk))
                blended[images, part, y, x] = below
        return blended

    def scatter(self, pixels: Tensor, *, correlate: bool = False) -> Tensor:
        """Return the light that pixels scatter."""
        grid = self.grid
        rows, columns = grid.rows * grid.tile[0], grid.columns * grid.across * grid.tile[1]
        full = pixels.new_zeros(*pixels.shape[:2], rows + grid.lost, columns + grid.lost)
        for chunk in self.plan.chunks:
            offsets = self._offsets(chunk)
            for part, spectra in zip(self.channels, self.conjugate if correlate else self.spectra, strict=True):
                own = self._own(pixels[:, part], chunk, offsets)
                light = own.new_zeros(math.prod(chunk.extent), *own.shape[1:])
                for blocks, pairs, layers in chunk.runs:
                    psfs = spectra[layers]
                    light[blocks] += own[pairs].unflatten(0, (-1, len(psfs))).mul_(psfs).sum(1)
                self._add_windows(full[:, part], torch.fft.ifft2(light), chunk)
        return full[..., : grid.shape[0] + grid.lost, : grid.shape[1] + grid.lost]

    def psf_gradient(self, plane: Tensor, pixels: Tensor, *, correlate: bool = False) -> Tensor:
        """Return the gradient of the PSFs, (D, C, P, P)."""
        sums = [torch.zeros_like(spectra) for spectra in self.spectra]
        for chunk in self.plan.chunks:
            offsets = self._offsets(chunk)
            for part, total in zip(self.channels, sums, strict=True):
                own = self._own(pixels[:, part], chunk, offsets)
                light = self._windows(plane[:, part], chunk).conj().resolve_conj()
                for blocks, pairs, layers in chunk.runs:
                    for block, of_layers in zip(
                        light[blocks], own[pairs].unflatten(0, (-1, len(total[layers]))), strict=True
                    ):
                        total[layers].addcmul_(of_layers, block)
        # Left and right tiles correlate with themselves in the real part, with each other in the imaginary part.
        spectra, side = torch.cat(sums, 1), self.grid.lost + 1
        found = torch.fft.ifft2(spectra.conj() if correlate else spectra).real[..., :side, :side]
        return torch.zeros_like(self.psfs).index_copy_(0, self.plan.layers, found)

    def _weight(self, chunk: Chunk) -> Tensor:
        weight = self.labels.layer_weight
        assert weight is not None
        return weight[chunk.pixels].unsqueeze(1)

    def _offsets(self, chunk: Chunk) -> list[Tensor]:
        """Find each of a chunk's pixels in the planes of its layers and channels, in floats: (b, c, h, w)."""
        grid, (height, width), (down, across) = self.grid, self.grid.size, self.grid.tile
        images, y, x = (torch.arange(part.start, part.stop, device=self.psfs.device) for part in chunk.pixels)
        plane, channels = 2 * height * width, torch.arange(self.together, device=self.psfs.device)
        inside = ((y % down + self.inner) * (2 * width))[:, None] + 2 * (x % across + self.inner) + x // across % 2
        inside, keys = inside + (plane * channels)[:, None, None], grid.number(images, y, x) * len(self.psfs)
        start = (self.plan.number.flatten() - chunk.first) * (plane * self.together)
        return [start.take(keys + layer).unsqueeze(1) + inside for layer in self.labels.terms(*chunk.pixels)]

    def _windows(self, plane: Tensor, chunk: Chunk) -> Tensor:
        """Return the spectra of a chunk's windows of a plane, (blocks, c, height, width)."""
        return torch.fft.fft2(torch.view_as_complex(windows(part_of(plane, chunk, self.grid), self.grid)))

    def _own(self, pixels: Tensor, chunk: Chunk, offsets: list[Tensor]) -> Tensor:
        """Return the spectra of a chunk's pixels, each in the planes of its layers: (pairs, c, height, width)."""
        images, y, x = chunk.pixels
        light = pixels[images, :, y, x]
        planes = light.new_zeros(len(chunk.layer), light.shape[1], *self.grid.size, 2)
        below, *above = offsets
        for nearer in above:
            weighted = light * self._weight(chunk)
            planes.view(-1).index_put_((nearer,), weighted)  # put_ is refused where determinism is asked for
            light = torch.where(below == nearer, light, light - weighted)
        planes.view(-1).index_put_((below,), light)
        return torch.fft.fft2(torch.view_as_complex(planes))

    def _add_windows(self, full: Tensor, light: Tensor, chunk: Chunk) -> None:
        """Add a chunk's windows to a plane where :func:`~.tiles.windows` cuts them: its transpose."""
        (_, rows, columns), (images, top, left) = chunk.extent, chunk.pixels
        (height, width), (down, across) = self.grid.size, self.grid.tile
        tiles = torch.view_as_real(light).unflatten(0, chunk.extent).movedim(3, 1)  # (b, c, rows, columns, h, w, 2)
        # In pieces that meet no pixel twice in one addition.
        step = down if rows > 1 else height, 2 * across if columns > 1 else width
        for half, i, j in product(range(2), range(0, height, step[0]), range(0, width, step[1])):
            piece = tiles[..., i : i + step[0], j : j + step[1], half]
            y, x = top.start + i, left.start + j + half * across
            h, w = piece.shape[-2:]
            own = full[images, :, y : y + (rows - 1) * down + h, x : x + (columns - 1) * 2 * across + w]
            own.unfold(2, h, down).unfold(3, w, 2 * across).add_(piece)
