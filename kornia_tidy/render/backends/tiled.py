"""Exact rendering by tiles: a tile is convolved with the PSFs of the layers it contains and with no other.

Overlap-save for gather, overlap-add for scatter. Each is the other's transpose, so forward and backward passes are made
of the same four steps: cut windows out of a plane, add windows to a plane, put pixels into the planes of their layers,
take pixels out of the planes of their layers. The planes of one chunk of tiles exist at a time, in one channel. For the
backward pass only the inputs are kept; spectra are computed again.

Small PSFs are convolved directly instead where that takes less time, see :mod:`kornia_tidy.render.backends.direct`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from typing import Any, NamedTuple

import torch
from torch import Tensor

from kornia_tidy.render.backends.allocator import keep_memory
from kornia_tidy.render.backends.direct import correlate_directly, goes_directly, mix_directly
from kornia_tidy.render.backends.summed import differentiable_slopes, mix_layers, spread_layers
from kornia_tidy.render.backends.tile_plan import Chunk, Labels, Plan, make_plan
from kornia_tidy.render.borders import pad_border


def blur_then_mix(image: Tensor, psfs: Tensor, lower: Tensor, fraction: Tensor | None, border: str) -> Tensor:
    """Convolve an image with each layer's PSF and let each pixel take its layers: gather.

    Args:
        image: (B, C, H, W) light.
        psfs: (D, C, P, P) of the image's dtype.
        lower: int64 index of each pixel's layer, (B or 1, 1) and the height and width of the output.
        fraction: share of the next layer, like ``lower``, or None for none.
        border: what lies beyond the image, see :mod:`kornia_tidy.render.borders`.

    Returns:
        (B, C, H, W), or smaller by P - 1 for ``"valid"``. It has gradients with respect to image, psfs and fraction;
        where they are differentiated in turn, they are made by :mod:`kornia_tidy.render.backends.summed`.
    """
    labels, fraction = _labels(lower, fraction, len(image))
    if goes_directly(labels, len(psfs), psfs.shape[-1], psfs.dtype):
        return _MixDirectly.apply(pad_border(image, psfs.shape[-1] // 2, border), psfs, fraction, labels)
    plan = make_plan(labels, len(psfs), psfs.shape[-1])
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
        border: what lies beyond the image, see :mod:`kornia_tidy.render.borders`.

    Returns:
        As :func:`blur_then_mix`.
    """
    radius = psfs.shape[-1] // 2
    # Black beyond the border may lie in any layer: in one that is there anyway.
    sides = "replicate" if border == "zero" else border
    lower = pad_border(lower.to(image.dtype), radius, sides).long()
    fraction = None if fraction is None else pad_border(fraction, radius, sides)
    labels, fraction = _labels(lower, fraction, len(image))
    plan = make_plan(labels, len(psfs), psfs.shape[-1])
    plane = pad_border(image, radius, border)
    return _SplitThenBlur.apply(plane, psfs, fraction, plan)


def _labels(lower: Tensor, fraction: Tensor | None, batch: int) -> tuple[Labels, Tensor | None]:
    """Return the layers of each image's pixels, and the fraction as (B, H, W)."""
    keep_memory()
    fraction = None if fraction is None else fraction[:, 0].expand(batch, -1, -1)
    return Labels.of(lower[:, 0].expand(batch, -1, -1), fraction), fraction


def _twice(
    render: Callable[..., Tensor], planes: Sequence[Tensor | None], labels: Labels, grad: Tensor, wanted: Sequence[bool]
) -> list[Tensor | None]:
    """Return the gradients with respect to plane, psfs and fraction so that they can be differentiated in turn.

    The plane may have spare rows and columns, which no pixel of the output sees.
    """
    psfs = planes[1]
    assert psfs is not None
    height, width = labels.lower.shape[-2:]
    if render is mix_layers:
        height, width = height + psfs.shape[-1] - 1, width + psfs.shape[-1] - 1

    def rendered(plane: Tensor, psfs: Tensor, fraction: Tensor | None) -> Tensor:
        return render(plane[..., :height, :width], psfs, fraction, labels.lower)

    return differentiable_slopes(rendered, planes, grad, wanted[:3])


class _BlurThenMix(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, plane: Tensor, psfs: Tensor, fraction: Tensor | None, plan: Plan) -> Tensor:
        ctx.save_for_backward(plane, psfs, fraction)
        ctx.plan = plan
        work = _Work(plan, psfs, psfs.shape[-1] - 1)
        mixed = plane.new_empty(*plane.shape[:2], plan.grid.height, plan.grid.width)
        for chunk, places, c in work.steps():
            light = torch.fft.fft2(work.windows(plane[:, c], chunk))
            work.mix_into(mixed[:, c][chunk.pixels], torch.fft.ifft2(work.blur(light, work.spectra[c], chunk)), places)
        return mixed

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        (grad,) = grad_outputs
        if torch.is_grad_enabled():
            return *_twice(mix_layers, ctx.saved_tensors, ctx.plan.labels, grad, ctx.needs_input_grad), None
        plane, psfs, _ = ctx.saved_tensors
        return *_mix_slopes(plane, psfs, grad, ctx.plan, ctx.needs_input_grad), None


def _mix_slopes(
    plane: Tensor, psfs: Tensor, grad: Tensor, plan: Plan, wanted: Sequence[bool]
) -> tuple[Tensor | None, Tensor | None, Tensor | None]:
    """Return the gradients of mixed light with respect to plane, psfs and fraction, where they are wanted."""
    work = _Work(plan, psfs, psfs.shape[-1] - 1)
    slopes = _Slopes(wanted, plane, work)
    full = work.tiled_plane(plane) if slopes.plane else None
    for chunk, places, c in work.steps():
        if slopes.plane or slopes.psfs is not None:
            own = torch.fft.fft2(work.put(grad[:, c][chunk.pixels], places, chunk))
        if slopes.fraction is not None or slopes.psfs is not None:
            light = torch.fft.fft2(work.windows(plane[:, c], chunk))
        if slopes.fraction is not None:
            blurred = torch.fft.ifft2(work.blur(light, work.spectra[c], chunk))
            slopes.add_fraction(blurred, grad[:, c][chunk.pixels], places, chunk)
        if slopes.psfs is not None:
            slopes.add_psfs(light, own, chunk, c)
        if full is not None:
            work.add_windows(full[:, c], torch.fft.ifft2(work.sum_layers(own, work.turned[c], chunk)), chunk)
    if full is not None:
        full = full[..., : plane.shape[-2], : plane.shape[-1]]
    return full, slopes.of_psfs(psfs, turned=False), slopes.fraction


class _MixDirectly(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, plane: Tensor, psfs: Tensor, fraction: Tensor | None, labels: Labels) -> Tensor:
        ctx.save_for_backward(plane, psfs, fraction)
        ctx.labels = labels
        return mix_directly(plane, psfs, labels)

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        (grad,) = grad_outputs
        (plane, psfs, _), labels = ctx.saved_tensors, ctx.labels
        wanted = ctx.needs_input_grad
        if torch.is_grad_enabled():
            return *_twice(mix_layers, ctx.saved_tensors, labels, grad, wanted), None
        of_plane = of_psfs = of_fraction = None
        if wanted[0]:  # a pixel's light goes to pixels of many layers: by tiles
            plan = make_plan(labels, len(psfs), psfs.shape[-1])
            of_plane, _, _ = _mix_slopes(plane, psfs, grad, plan, (True, False, False))
        if wanted[1]:
            of_psfs = correlate_directly(plane, grad, labels, psfs.shape)
        if wanted[2]:
            of_fraction = mix_directly(plane, psfs, labels, slope=True).mul_(grad).sum(1)
        return of_plane, of_psfs, of_fraction, None


class _SplitThenBlur(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, plane: Tensor, psfs: Tensor, fraction: Tensor | None, plan: Plan) -> Tensor:
        ctx.save_for_backward(plane, psfs, fraction)
        ctx.plan = plan
        work = _Work(plan, psfs, 0)
        full = work.tiled_plane(plane)
        for chunk, places, c in work.steps():
            own = torch.fft.fft2(work.put(plane[:, c][chunk.pixels], places, chunk))
            work.add_windows(full[:, c], torch.fft.ifft2(work.sum_layers(own, work.spectra[c], chunk)), chunk)
        return full[..., psfs.shape[-1] - 1 : plane.shape[-2], psfs.shape[-1] - 1 : plane.shape[-1]]

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        (grad,) = grad_outputs
        (plane, psfs, _), plan = ctx.saved_tensors, ctx.plan
        if torch.is_grad_enabled():
            return *_twice(spread_layers, ctx.saved_tensors, plan.labels, grad, ctx.needs_input_grad), None
        work = _Work(plan, psfs, 0)
        slopes = _Slopes(ctx.needs_input_grad, plane, work)
        mixed = torch.empty_like(plane) if slopes.plane else None
        full = torch.nn.functional.pad(grad, (psfs.shape[-1] - 1,) * 4)
        for chunk, places, c in work.steps():
            light = torch.fft.fft2(work.windows(full[:, c], chunk))
            if slopes.psfs is not None:
                slopes.add_psfs(light, torch.fft.fft2(work.put(plane[:, c][chunk.pixels], places, chunk)), chunk, c)
            if mixed is not None or slopes.fraction is not None:
                blurred = torch.fft.ifft2(work.blur(light, work.turned[c], chunk))
                if slopes.fraction is not None:
                    slopes.add_fraction(blurred, plane[:, c][chunk.pixels], places, chunk)
                if mixed is not None:
                    work.mix_into(mixed[:, c][chunk.pixels], blurred, places)
        return mixed, slopes.of_psfs(psfs, turned=True), slopes.fraction, None


class Places(NamedTuple):
    """Where pixels stand in the planes of their lower layers, in floats; and in those above, with the share there."""

    below: Tensor
    above: tuple[Tensor, Tensor] | None


class _Work:
    """The steps of one pass over a plan, for one channel of one chunk each, in memory that all of them use again.

    Fetching memory from the system takes as long as the transforms in it.

    Args:
        plan: what to compute.
        psfs: (D, C, P, P).
        offset: where a tile's first pixel stands in its window, down and across.
    """

    def __init__(self, plan: Plan, psfs: Tensor, offset: int) -> None:
        self.plan, self._psfs = plan, psfs
        self._memory: dict[tuple[str, torch.dtype], Tensor] = {}
        self._dtype, self._device = psfs.dtype, psfs.device
        size, tile = plan.grid.size, plan.grid.tile
        images = torch.arange(max(chunk.batch.stop - chunk.batch.start for chunk in plan.chunks), device=psfs.device)
        y = torch.arange(max(chunk.y.stop - chunk.y.start for chunk in plan.chunks), device=psfs.device)
        x = torch.arange(plan.grid.width, device=psfs.device)
        # A pixel's block times the number of layers, and where it stands in its window, counted in floats: alike for
        # all rows of blocks.
        self._number = plan.grid.number(images, y, x) * plan.start.shape[1]
        self._inside = ((y % tile + offset) * (2 * size))[:, None] + (2 * (x % tile + offset) + x // tile % 2)

    @cached_property
    def spectra(self) -> Tensor:
        """(C, D', size, size) spectra of the PSFs of the layers that are present."""
        psfs = self._psfs.transpose(0, 1).index_select(1, self.plan.present)
        return torch.fft.fft2(psfs, s=(self.plan.grid.size, self.plan.grid.size))

    @cached_property
    def turned(self) -> Tensor:
        """Spectra of the PSFs turned by 180 degrees: correlation is the transpose of convolution."""
        return torch.conj_physical(self.spectra)

    def no_spectra(self) -> Tensor:
        """Return zeros of the shape of :attr:`spectra`."""
        shape = (self._psfs.shape[1], len(self.plan.present), self.plan.grid.size, self.plan.grid.size)
        return self._psfs.new_zeros(shape, dtype=self._dtype.to_complex())

    def steps(self) -> Iterator[tuple[Chunk, Places, int]]:
        """Yield each channel of each chunk, and the places of the chunk's pixels, which all channels share."""
        for chunk in self.plan.chunks:
            places = self.places(chunk)
            for channel in range(self._psfs.shape[1]):
                yield chunk, places, channel

    def _buffer(self, name: str, shape: Sequence[int], dtype: torch.dtype | None = None) -> Tensor:
        """Memory by name, with whatever was left in it."""
        count, key = math.prod(shape), (name, dtype or self._dtype)
        if key not in self._memory or len(self._memory[key]) < count:
            self._memory[key] = torch.empty(count, dtype=key[1], device=self._device)
        return self._memory[key][:count].view(*shape)

    def _planes(self, name: str, *count: int) -> Tensor:
        """Complex planes by name, (*count, size, size), with whatever was left in them."""
        size = self.plan.grid.size
        return self._buffer(name, (*count, size, size), self._dtype.to_complex())

    def windows(self, plane: Tensor, chunk: Chunk) -> Tensor:
        """Cut a chunk's windows out of a (B, H', W') plane, black beyond its ends: (blocks, size, size) complex."""
        size, tile = self.plan.grid.size, self.plan.grid.tile
        images, rows, columns = chunk.extent
        height, width = (rows - 1) * tile + size, (2 * columns - 1) * tile + size
        part = plane[chunk.batch, chunk.y.start : chunk.y.start + height, chunk.x.start : chunk.x.start + width]
        if part.shape[1:] != (height, width):
            whole = self._buffer("part", (images, height, width))
            whole[:, part.shape[1] :] = 0
            whole[:, : part.shape[1], part.shape[2] :] = 0
            whole[:, : part.shape[1], : part.shape[2]] = part
            part = whole
        tiles, cut = part.unfold(1, size, tile).unfold(2, size, tile), self._planes("windows", *chunk.extent)
        return torch.complex(tiles[:, :, 0::2], tiles[:, :, 1::2], out=cut).flatten(0, 2)

    def add_windows(self, plane: Tensor, windows: Tensor, chunk: Chunk) -> None:
        """Add a chunk's windows to a plane where :meth:`windows` cuts them: its transpose."""
        size, tile = self.plan.grid.size, self.plan.grid.tile
        rows, columns = chunk.extent[1:]
        halves = torch.view_as_real(windows).unflatten(0, chunk.extent).movedim(-1, 0)
        for half, light in enumerate(halves):
            left = chunk.x.start + half * tile
            across = plane[chunk.batch, :, left : left + (columns - 1) * 2 * tile + size]
            # Of every second tile, windows overlap with the row above and below only, by less than a tile: first the
            # tiles, then what hangs over, so that no pixel is met twice in one addition.
            for start, stop in ((0, tile), (tile, size)):
                if start < stop:
                    top = chunk.y.start + start
                    down = across[:, top : top + (rows - 1) * tile + stop - start]
                    down.unfold(1, stop - start, tile).unfold(2, size, 2 * tile).add_(light[..., start:stop, :])

    def tiled_plane(self, plane: Tensor) -> Tensor:
        """Return a black plane that holds the windows of all blocks."""
        grid = self.plan.grid
        overlap = grid.size - grid.tile
        return plane.new_zeros(*plane.shape[:2], grid.covered_height + overlap, grid.covered_width + overlap)

    def blur(self, light: Tensor, spectra: Tensor, chunk: Chunk) -> Tensor:
        """Each pair's light times the spectrum of its layer: (pairs, size, size)."""
        pairs = self._planes("pairs", len(chunk.layer))
        if not _by_slices(light):
            return torch.index_select(spectra, 0, chunk.layer, out=pairs).mul_(light.index_select(0, chunk.block))
        for run in chunk.runs:
            torch.mul(spectra[run.layers], light[run.block], out=pairs[run.pairs])
        return pairs

    def sum_layers(self, own: Tensor, spectra: Tensor, chunk: Chunk) -> Tensor:
        """Each block's sum over its layers of their light times their spectrum. Writes over ``own``."""
        total = self._planes("windows", len(chunk.counts))
        if not _by_slices(own):
            own.mul_(torch.index_select(spectra, 0, chunk.layer, out=self._planes("pairs", len(own))))
            return total.zero_().index_add_(0, chunk.block, own)
        for run in chunk.runs:
            own[run.pairs].mul_(spectra[run.layers])
        for block, pairs in zip(total, own.split(chunk.counts), strict=True):
            torch.sum(pairs, 0, out=block)
        return total

    def places(self, chunk: Chunk) -> Places:
        """Find each of a chunk's pixels in the planes of its layers."""
        images, y, x = chunk.pixels
        number = self._number[: images.stop - images.start, : y.stop - y.start, x]
        # Blocks are counted from the first of the chunk's first row.
        start = self.plan.start[(images.start * self.plan.grid.rows + chunk.rows.start) * self.plan.grid.columns :]
        key = self._buffer("key", number.shape, torch.int64)
        found = []
        for layer in self.plan.labels.terms(images, y, x):
            torch.add(layer, number, out=key)
            place = self._buffer(f"place {len(found)}", (key.numel(),), torch.int64)
            torch.index_select(start.view(-1), 0, key.view(-1), out=place)
            found.append(place.view(key.shape).add_(self._inside[: y.stop - y.start, x]))
        fraction = self.plan.labels.fraction
        return Places(found[0], None if fraction is None else (found[1], fraction[images, y, x]))

    def mix_into(self, mixed: Tensor, planes: Tensor, places: Places) -> None:
        """Write each pixel's mean over its layers."""
        floats = torch.view_as_real(planes)
        torch.take(floats, places.below, out=mixed)
        if places.above is not None:
            above, share = places.above
            mixed.lerp_(torch.take(floats, above, out=self._buffer("above", mixed.shape)), share)

    def put(self, light: Tensor, places: Places, chunk: Chunk) -> Tensor:
        """Share each pixel out to the planes of its layers, the transpose of taking: (pairs, size, size) complex."""
        planes = self._planes("pairs", len(chunk.layer)).zero_()
        floats = torch.view_as_real(planes).view(-1)
        if places.above is not None:
            above, share = places.above
            shared = light * share
            floats.index_put_((above,), shared)  # put_ is refused where determinism is asked for
            light = torch.where(places.below == above, light, light - shared)
        floats.index_put_((places.below,), light)
        return planes


class _Slopes:
    """Gradients that a backward pass collects chunk by chunk, where they are wanted."""

    def __init__(self, wanted: Sequence[bool], plane: Tensor, work: _Work) -> None:
        self.work = work
        self.plane = wanted[0]
        self.psfs = work.no_spectra() if wanted[1] else None
        self.fraction = plane.new_zeros(work.plan.labels.lower.shape) if wanted[2] else None

    def add_fraction(self, blurred: Tensor, factor: Tensor, places: Places, chunk: Chunk) -> None:
        """What a pixel gains when its light moves to the layer above, times the gradient or the light it has."""
        assert self.fraction is not None
        assert places.above is not None
        floats = torch.view_as_real(blurred)
        self.fraction[chunk.pixels] += (floats.take(places.above[0]) - floats.take(places.below)) * factor

    def add_psfs(self, light: Tensor, own: Tensor, chunk: Chunk, channel: int) -> None:
        """Correlate the layers' own pixels with the light of their windows."""
        assert self.psfs is not None
        light, sums = torch.conj_physical(light), self.psfs[channel]
        if not _by_slices(light):
            sums.index_add_(0, chunk.layer, light.index_select(0, chunk.block).mul_(own))
            return
        for run in chunk.runs:
            sums[run.layers].addcmul_(light[run.block], own[run.pairs])

    def of_psfs(self, psfs: Tensor, *, turned: bool) -> Tensor | None:
        """Left and right tiles correlate with themselves in the real part, with each other in the imaginary part."""
        if self.psfs is None:
            return None
        side = psfs.shape[-1]
        slope = torch.zeros_like(psfs)
        found = torch.fft.ifft2(self.psfs.conj() if turned else self.psfs).real[..., :side, :side]
        slope[self.work.plan.present] = found.transpose(0, 1)
        return slope


def _by_slices(planes: Tensor) -> bool:
    """Slices pass over a processor's memory less often; all pairs at once start fewer kernels on an accelerator."""
    return planes.device.type == "cpu"
