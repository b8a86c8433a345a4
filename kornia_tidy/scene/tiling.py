"""Exact rendering by tiles: a tile is convolved with the PSFs of the layers it contains and with no other.

Overlap-save for gather, overlap-add for scatter. Each is the other's transpose, so forward and backward passes are made
of the same four steps: cut windows out of a plane, add windows to a plane, put pixels into the planes of their layers,
take pixels out of the planes of their layers. The planes of one chunk of tiles exist at a time. For the backward pass
only the inputs are kept; spectra are computed again.

There is no direct convolution: it would pay for PSFs of a single pixel only (at 3 x 3 a loop over their pixels takes
1.2 times as long as this, at 5 x 5 4.4 times; 1.4 megapixels, 21 layers, one core).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from kornia_tidy.scene.convolution import pad_border
from kornia_tidy.scene.tiles import Chunk, Labels, Plan, make_plan


def blur_then_mix(image: Tensor, psfs: Tensor, lower: Tensor, fraction: Tensor | None, border: str) -> Tensor:
    """Convolve an image with each layer's PSF and let each pixel take its layers: gather.

    Args:
        image: (B, C, H, W) light.
        psfs: (D, C, P, P) of the image's dtype.
        lower: int64 index of each pixel's layer, (B or 1, 1) and the height and width of the output.
        fraction: share of the next layer, like ``lower``, or None for none.
        border: what lies beyond the image, see :mod:`kornia_tidy.scene.convolution`.

    Returns:
        (B, C, H, W), or smaller by P - 1 for ``"valid"``. It has gradients with respect to image, psfs and fraction,
        but no second ones.
    """
    plan, fraction = _plan(image, psfs, lower, fraction)
    spare = (plan.grid.covered_height - plan.grid.height, plan.grid.covered_width - plan.grid.width)
    plane = pad_border(image, psfs.shape[-1] // 2, border, spare)
    return _BlurThenMix.apply(plane, psfs, fraction, plan)


def split_then_blur(image: Tensor, psfs: Tensor, lower: Tensor, fraction: Tensor | None, border: str) -> Tensor:
    """Convolve the light of each layer's pixels with its PSF and add up: scatter.

    Args:
        image: (B, C, H, W) light.
        psfs: (D, C, P, P) of the image's dtype.
        lower: (B or 1, 1, H, W) int64 index of each pixel's layer.
        fraction: share of the next layer, like ``lower``, or None for none.
        border: what lies beyond the image, see :mod:`kornia_tidy.scene.convolution`.

    Returns:
        As :func:`blur_then_mix`.
    """
    radius = psfs.shape[-1] // 2
    # Black beyond the border may lie in any layer: in one that is there anyway.
    sides = "replicate" if border == "zero" else border
    lower = pad_border(lower.to(image.dtype), radius, sides).long()
    fraction = None if fraction is None else pad_border(fraction, radius, sides)
    plan, fraction = _plan(image, psfs, lower, fraction)
    plane = pad_border(image, radius, border)
    return _SplitThenBlur.apply(plane, psfs, fraction, plan)


def _plan(image: Tensor, psfs: Tensor, lower: Tensor, fraction: Tensor | None) -> tuple[Plan, Tensor | None]:
    """Return the plan, and the fraction as (B, H, W)."""
    lower = lower[:, 0].expand(len(image), -1, -1)
    fraction = None if fraction is None else fraction[:, 0].expand(len(image), -1, -1)
    return make_plan(Labels.of(lower, fraction), len(psfs), psfs.shape[-1], image.shape[1]), fraction


class _BlurThenMix(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, plane: Tensor, psfs: Tensor, fraction: Tensor | None, plan: Plan) -> Tensor:
        ctx.save_for_backward(plane, psfs)
        ctx.plan = plan
        work = _Work(plan, psfs, psfs.shape[-1] - 1)
        mixed = plane.new_empty(*plane.shape[:2], plan.grid.height, plan.grid.width)
        for chunk in plan.chunks:
            light = torch.fft.fft2(work.windows(plane, chunk))
            work.mix_into(mixed, torch.fft.ifft2(work.product(light, work.spectra, chunk)), chunk)
        return mixed

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        (plane, psfs), plan = ctx.saved_tensors, ctx.plan
        work = _Work(plan, psfs, psfs.shape[-1] - 1)
        turned = torch.conj_physical(work.spectra)  # correlation is the transpose of convolution
        slopes = _Slopes(ctx.needs_input_grad, plane, work)
        full = work.tiled_plane(plane) if slopes.plane else None
        for chunk in plan.chunks:
            if slopes.plane or slopes.psfs is not None:
                own = torch.fft.fft2(work.put(grad, chunk))
            if slopes.fraction is not None or slopes.psfs is not None:
                light = torch.fft.fft2(work.windows(plane, chunk))
            if slopes.fraction is not None:
                slopes.add_fraction(torch.fft.ifft2(work.product(light, work.spectra, chunk)), grad, chunk)
            if slopes.psfs is not None:
                slopes.add_psfs(light, own, chunk)
            if full is not None:
                work.add_windows(full, torch.fft.ifft2(work.sum_layers(own, turned, chunk)), chunk)
        if full is not None:
            full = full[..., : plane.shape[-2], : plane.shape[-1]]
        return full, slopes.of_psfs(psfs, turned=False), slopes.fraction, None


class _SplitThenBlur(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, plane: Tensor, psfs: Tensor, fraction: Tensor | None, plan: Plan) -> Tensor:
        ctx.save_for_backward(plane, psfs)
        ctx.plan = plan
        work = _Work(plan, psfs, 0)
        full = work.tiled_plane(plane)
        for chunk in plan.chunks:
            own = torch.fft.fft2(work.put(plane, chunk))
            work.add_windows(full, torch.fft.ifft2(work.sum_layers(own, work.spectra, chunk)), chunk)
        return full[..., psfs.shape[-1] - 1 : plane.shape[-2], psfs.shape[-1] - 1 : plane.shape[-1]]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        (plane, psfs), plan = ctx.saved_tensors, ctx.plan
        work = _Work(plan, psfs, 0)
        turned = torch.conj_physical(work.spectra)
        slopes = _Slopes(ctx.needs_input_grad, plane, work)
        mixed = torch.empty_like(plane) if slopes.plane else None
        full = torch.nn.functional.pad(grad, (psfs.shape[-1] - 1,) * 4)
        for chunk in plan.chunks:
            light = torch.fft.fft2(work.windows(full, chunk))
            if slopes.psfs is not None:
                slopes.add_psfs(light, torch.fft.fft2(work.put(plane, chunk)), chunk)
            if mixed is not None or slopes.fraction is not None:
                blurred = torch.fft.ifft2(work.product(light, turned, chunk))
                if slopes.fraction is not None:
                    slopes.add_fraction(blurred, plane, chunk)
                if mixed is not None:
                    work.mix_into(mixed, blurred, chunk)
        return mixed, slopes.of_psfs(psfs, turned=True), slopes.fraction, None


class _Work:
    """The steps of one pass over a plan, in memory that every chunk uses again.

    Fetching memory from the system takes as long as the transforms in it.

    Args:
        plan: what to compute.
        psfs: (D, C, P, P).
        offset: where a tile's first pixel stands in its window, down and across.
    """

    def __init__(self, plan: Plan, psfs: Tensor, offset: int) -> None:
        self.plan = plan
        self._memory: dict[tuple[str, torch.dtype], Tensor] = {}
        self._dtype, self._device = psfs.dtype, psfs.device
        size, tile = plan.grid.size, plan.grid.tile
        # (D', C, size, size) spectra of the PSFs of the layers that are present.
        self.spectra = torch.fft.fft2(psfs.index_select(0, plan.present), s=(size, size))
        # Where a pixel stands in its window, counted in floats: alike for all rows of blocks.
        y = torch.arange(max(chunk.y.stop - chunk.y.start for chunk in plan.chunks), device=psfs.device) % tile
        x = torch.arange(plan.grid.width, device=psfs.device)
        self._inside = ((y + offset) * (2 * size))[:, None] + (2 * (x % tile + offset) + x // tile % 2)

    def _buffer(self, name: str, shape: Sequence[int], dtype: torch.dtype | None = None) -> Tensor:
        """Memory by name, with whatever was left in it."""
        count, key = math.prod(shape), (name, dtype or self._dtype)
        if key not in self._memory or len(self._memory[key]) < count:
            self._memory[key] = torch.empty(count, dtype=key[1], device=self._device)
        return self._memory[key][:count].view(*shape)

    def windows(self, plane: Tensor, chunk: Chunk) -> Tensor:
        """Cut a chunk's windows out of a plane, which is black beyond its ends: (blocks, C, size, size) complex."""
        size, tile = self.plan.grid.size, self.plan.grid.tile
        images, rows, columns = chunk.extent
        height, width = (rows - 1) * tile + size, (2 * columns - 1) * tile + size
        part = plane[chunk.batch, :, chunk.y.start : chunk.y.start + height, chunk.x.start : chunk.x.start + width]
        if part.shape[-2:] != (height, width):
            whole = self._buffer("part", (images, plane.shape[1], height, width))
            whole[..., part.shape[-2] :, :] = 0
            whole[..., : part.shape[-2], part.shape[-1] :] = 0
            whole[..., : part.shape[-2], : part.shape[-1]] = part
            part = whole
        tiles = part.unfold(2, size, tile).unfold(3, size, tile).permute(0, 2, 3, 1, 4, 5)
        shape = (images, rows, columns, plane.shape[1], size, size)
        cut = self._buffer("windows", shape, self._dtype.to_complex())
        return torch.complex(tiles[:, :, 0::2], tiles[:, :, 1::2], out=cut).flatten(0, 2)

    def add_windows(self, plane: Tensor, windows: Tensor, chunk: Chunk) -> None:
        """Add a chunk's windows to a plane where :meth:`windows` cuts them: its transpose."""
        size, tile = self.plan.grid.size, self.plan.grid.tile
        images, rows, columns = chunk.extent
        halves = torch.view_as_real(windows).unflatten(0, (images, rows, columns)).permute(6, 0, 3, 1, 2, 4, 5)
        for half, light in enumerate(halves):
            left = chunk.x.start + half * tile
            across = plane[chunk.batch, :, :, left : left + (columns - 1) * 2 * tile + size]
            # Of every second tile, windows overlap with the row above and below only, by less than a tile: first the
            # tiles, then what hangs over, so that no pixel is met twice in one addition.
            for start, stop in ((0, tile), (tile, size)):
                if start < stop:
                    top = chunk.y.start + start
                    down = across[:, :, top : top + (rows - 1) * tile + stop - start]
                    down.unfold(2, stop - start, tile).unfold(3, size, 2 * tile).add_(light[..., start:stop, :])

    def tiled_plane(self, plane: Tensor) -> Tensor:
        """Return a black plane that holds the windows of all blocks."""
        grid = self.plan.grid
        overlap = grid.size - grid.tile
        return plane.new_zeros(*plane.shape[:2], grid.covered_height + overlap, grid.covered_width + overlap)

    def product(self, light: Tensor, spectra: Tensor, chunk: Chunk) -> Tensor:
        """Each pair's light times the spectrum of its layer: (pairs, C, size, size)."""
        shape = (len(chunk.block), *light.shape[1:])
        product = torch.index_select(spectra, 0, chunk.layer, out=self._buffer("pairs", shape, light.dtype))
        if not _by_slices(light):
            return product.mul_(light.index_select(0, chunk.block))
        for own, block in zip(product.split(chunk.counts), light.unbind(), strict=True):
            own.mul_(block)
        return product

    def sum_layers(self, own: Tensor, spectra: Tensor, chunk: Chunk) -> Tensor:
        """Each block's sum over its layers of their light times their spectrum. May write over ``own``."""
        total = self._buffer("windows", (math.prod(chunk.extent), *own.shape[1:]), own.dtype).zero_()
        if not _by_slices(own):
            return total.index_add_(0, chunk.block, own.mul_(spectra.index_select(0, chunk.layer)))
        sums, pairs, layers = total.unbind(), own.unbind(), spectra.unbind()
        for block, layer, pair in zip(chunk.block.tolist(), chunk.layer.tolist(), pairs, strict=True):
            sums[block].addcmul_(pair, layers[layer])
        return total

    def places(self, chunk: Chunk) -> list[Tensor]:
        """Where each of a chunk's pixels stands in the planes of its layers, for the first channel, in floats."""
        inside = self._inside[: chunk.y.stop - chunk.y.start, chunk.x]
        found = []
        for number, key in enumerate(self.plan.labels.terms(chunk.batch, chunk.y, chunk.x)):
            place = self._buffer(f"places {number}", (key.numel(),), torch.int64)
            torch.index_select(self.plan.place, 0, key.reshape(-1), out=place)
            found.append(place.view(key.shape).add_(inside))
        return found

    def channel(self, planes: Tensor, channel: int) -> Tensor:
        """Return the floats of planes from the first of a channel on, where :meth:`places` point."""
        return torch.view_as_real(planes).view(-1)[channel * 2 * self.plan.grid.size**2 :]

    def mix_into(self, mixed: Tensor, planes: Tensor, chunk: Chunk) -> None:
        """Write each pixel's mean over its layers into (B, C, H, W)."""
        places, fraction = self.places(chunk), self.plan.labels.fraction
        for channel in range(mixed.shape[1]):
            there, own = mixed[chunk.pixels(channel)], self.channel(planes, channel)
            torch.take(own, places[0], out=there)
            if fraction is not None:
                above = torch.take(own, places[1], out=self._buffer("above", there.shape))
                there.lerp_(above, fraction[chunk.batch, chunk.y, chunk.x])

    def put(self, values: Tensor, chunk: Chunk) -> Tensor:
        """Share each pixel out to the planes of its layers: (pairs, C, size, size) complex, the transpose of taking."""
        size, channels, places = self.plan.grid.size, values.shape[1], self.places(chunk)
        planes = self._buffer("pairs", (len(chunk.block), channels, size, size), self._dtype.to_complex()).zero_()
        fraction = self.plan.labels.fraction
        for channel in range(channels):
            own, light = self.channel(planes, channel), values[chunk.pixels(channel)]
            if fraction is None:
                own.put_(places[0], light)
            else:
                shared = light * fraction[chunk.batch, chunk.y, chunk.x]
                own.put_(places[1], shared)
                own.put_(places[0], torch.where(places[0] == places[1], light, light - shared))
        return planes


class _Slopes:
    """Gradients that a backward pass collects chunk by chunk, where they are wanted."""

    def __init__(self, wanted: tuple[bool, ...], plane: Tensor, work: _Work) -> None:
        self.work = work
        self.plane = wanted[0]
        self.psfs = torch.zeros_like(work.spectra) if wanted[1] else None
        self.fraction = plane.new_zeros(work.plan.labels.first.shape) if wanted[2] else None

    def add_fraction(self, blurred: Tensor, factor: Tensor, chunk: Chunk) -> None:
        """What a pixel gains when its light moves to the layer above, times the gradient or the light it has."""
        assert self.fraction is not None
        places = self.work.places(chunk)
        for channel in range(factor.shape[1]):
            own = self.work.channel(blurred, channel)
            below, above = (own.take(place) for place in places)
            self.fraction[chunk.batch, chunk.y, chunk.x] += (above - below) * factor[chunk.pixels(channel)]

    def add_psfs(self, light: Tensor, own: Tensor, chunk: Chunk) -> None:
        """Correlate the layers' own pixels with the light of their windows."""
        assert self.psfs is not None
        light = torch.conj_physical(light)
        if not _by_slices(light):
            self.psfs.index_add_(0, chunk.layer, light.index_select(0, chunk.block).mul_(own))
            return
        sums, pairs, blocks = self.psfs.unbind(), own.unbind(), light.unbind()
        for block, layer, pair in zip(chunk.block.tolist(), chunk.layer.tolist(), pairs, strict=True):
            sums[layer].addcmul_(blocks[block], pair)

    def of_psfs(self, psfs: Tensor, *, turned: bool) -> Tensor | None:
        """Left and right tiles correlate with themselves in the real part, with each other in the imaginary part."""
        if self.psfs is None:
            return None
        side = psfs.shape[-1]
        slope = torch.zeros_like(psfs)
        found = torch.fft.ifft2(self.psfs.conj() if turned else self.psfs).real[..., :side, :side]
        slope[self.work.plan.present] = found
        return slope


def _by_slices(planes: Tensor) -> bool:
    """Slices pass over a processor's memory less often; all pairs at once start fewer kernels on an accelerator."""
    return planes.device.type == "cpu"
