"""Exact rendering by tiles: a tile is convolved with the PSFs of the layers it contains and with no other.

Overlap-save for gather, overlap-add for scatter. Each is the other's transpose, so forward and backward passes are made
of the same four steps: cut windows out of a plane, add windows to a plane, put pixels into the planes of their layers,
take pixels out of the planes of their layers. The planes of one chunk of tiles exist at a time. For the backward pass
only the inputs are kept; spectra are computed again.
"""

from __future__ import annotations

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
    sloped = fraction is not None and fraction.requires_grad and torch.is_grad_enabled()
    labels = Labels(lower, None if fraction is None else fraction.detach(), sloped)
    return make_plan(labels, len(psfs), psfs.shape[-1], image.shape[1]), fraction


class _BlurThenMix(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, plane: Tensor, psfs: Tensor, fraction: Tensor | None, plan: Plan) -> Tensor:
        ctx.save_for_backward(plane, psfs)
        ctx.plan = plan
        spectra = _spectra(psfs, plan)
        mixed = plane.new_empty(*plane.shape[:2], plan.grid.height, plan.grid.width)
        for chunk in plan.chunks:
            light = torch.fft.fft2(_windows(plane, plan, chunk))
            blurred = torch.fft.ifft2(_product(light, spectra, chunk))
            _mix_into(mixed, _take(blurred, _places(plan, chunk, psfs.shape[-1] - 1)), plan, chunk)
        return mixed

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        (plane, psfs), plan = ctx.saved_tensors, ctx.plan
        spectra = _spectra(psfs, plan)
        turned = torch.conj_physical(spectra)  # correlation is the transpose of convolution
        slopes = _Slopes(ctx.needs_input_grad, plane, spectra, plan)
        full = _tiled_plane(plane, plan) if slopes.plane else None
        for chunk in plan.chunks:
            places = _places(plan, chunk, psfs.shape[-1] - 1)
            if slopes.plane or slopes.psfs is not None:
                own = torch.fft.fft2(_put(grad, places, plan, chunk))
            if slopes.fraction is not None or slopes.psfs is not None:
                light = torch.fft.fft2(_windows(plane, plan, chunk))
            if slopes.fraction is not None:
                slopes.add_fraction(_take(torch.fft.ifft2(_product(light, spectra, chunk)), places), grad, chunk)
            if slopes.psfs is not None:
                slopes.add_psfs(torch.conj_physical(light), own, chunk)
            if full is not None:
                _add_windows(full, torch.fft.ifft2(_sum_layers(own, turned, chunk)), plan, chunk)
        if full is not None:
            full = full[..., : plane.shape[-2], : plane.shape[-1]]
        return full, slopes.of_psfs(psfs, plan, turned=False), slopes.fraction, None


class _SplitThenBlur(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, plane: Tensor, psfs: Tensor, fraction: Tensor | None, plan: Plan) -> Tensor:
        ctx.save_for_backward(plane, psfs)
        ctx.plan = plan
        spectra = _spectra(psfs, plan)
        full = _tiled_plane(plane, plan)
        for chunk in plan.chunks:
            own = torch.fft.fft2(_put(plane, _places(plan, chunk, 0), plan, chunk))
            _add_windows(full, torch.fft.ifft2(_sum_layers(own, spectra, chunk)), plan, chunk)
        return full[..., psfs.shape[-1] - 1 : plane.shape[-2], psfs.shape[-1] - 1 : plane.shape[-1]]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        (plane, psfs), plan = ctx.saved_tensors, ctx.plan
        spectra = _spectra(psfs, plan)
        turned = torch.conj_physical(spectra)
        slopes = _Slopes(ctx.needs_input_grad, plane, spectra, plan)
        mixed = torch.empty_like(plane) if slopes.plane else None
        full = torch.nn.functional.pad(grad, (psfs.shape[-1] - 1,) * 4)
        for chunk in plan.chunks:
            places = _places(plan, chunk, 0)
            light = torch.fft.fft2(_windows(full, plan, chunk))
            if slopes.psfs is not None:
                own = torch.fft.fft2(_put(plane, places, plan, chunk))
                slopes.add_psfs(torch.conj_physical(light), own, chunk)
            if mixed is not None or slopes.fraction is not None:
                terms = _take(torch.fft.ifft2(_product(light, turned, chunk)), places)
                if slopes.fraction is not None:
                    slopes.add_fraction(terms, plane, chunk)
                if mixed is not None:
                    _mix_into(mixed, terms, plan, chunk)
        return mixed, slopes.of_psfs(psfs, plan, turned=True), slopes.fraction, None


class _Slopes:
    """Gradients that a backward pass collects chunk by chunk, where they are wanted."""

    def __init__(self, wanted: tuple[bool, ...], plane: Tensor, spectra: Tensor, plan: Plan) -> None:
        self.plane = wanted[0]
        self.psfs = torch.zeros_like(spectra) if wanted[1] else None
        self.fraction = plane.new_zeros(plan.labels.first.shape) if wanted[2] else None

    def add_fraction(self, terms: list[list[Tensor]], factor: Tensor, chunk: Chunk) -> None:
        """What a pixel gains when its light moves to the layer above, times the gradient or the light it has."""
        assert self.fraction is not None
        for channel, (below, above) in enumerate(terms):
            self.fraction[chunk.batch, chunk.y, chunk.x] += (above - below) * factor[chunk.pixels(channel)]

    def add_psfs(self, light: Tensor, own: Tensor, chunk: Chunk) -> None:
        """Correlate the layers' own pixels with the light of their windows, of which ``light`` is the conjugate."""
        assert self.psfs is not None
        if not _by_slices(light):
            self.psfs.index_add_(0, chunk.layer, light.index_select(0, chunk.block).mul_(own))
            return
        for run in chunk.runs:
            for block, pair in zip(light[run.blocks], own[run.pairs], strict=True):
                self.psfs[run.layer].addcmul_(block, pair)

    def of_psfs(self, psfs: Tensor, plan: Plan, *, turned: bool) -> Tensor | None:
        """Left and right tiles correlate with themselves in the real part, with each other in the imaginary part."""
        if self.psfs is None:
            return None
        side = psfs.shape[-1]
        slope = torch.zeros_like(psfs)
        slope[plan.present] = torch.fft.ifft2(self.psfs.conj() if turned else self.psfs).real[..., :side, :side]
        return slope


def _spectra(psfs: Tensor, plan: Plan) -> Tensor:
    """(D', C, size, size) spectra of the PSFs of the layers that are present."""
    return torch.fft.fft2(psfs.index_select(0, plan.present), s=(plan.grid.size, plan.grid.size))


def _by_slices(planes: Tensor) -> bool:
    """Slices pass over a processor's memory less often; all pairs at once start fewer kernels on an accelerator."""
    return planes.device.type == "cpu"


def _product(light: Tensor, spectra: Tensor, chunk: Chunk) -> Tensor:
    """Each pair's light times the spectrum of its layer: (pairs, C, size, size)."""
    if not _by_slices(light):
        return light.index_select(0, chunk.block).mul_(spectra.index_select(0, chunk.layer))
    product = light.new_empty(len(chunk.block), *light.shape[1:])
    for run in chunk.runs:
        torch.mul(light[run.blocks], spectra[run.layer], out=product[run.pairs])
    return product


def _sum_layers(own: Tensor, spectra: Tensor, chunk: Chunk) -> Tensor:
    """Each block's sum over its layers of their light times their spectrum. May write over ``own``."""
    images, rows, columns = chunk.extent
    total = own.new_zeros(images * rows * columns, *own.shape[1:])
    if not _by_slices(own):
        return total.index_add_(0, chunk.block, own.mul_(spectra.index_select(0, chunk.layer)))
    for run in chunk.runs:
        total[run.blocks].addcmul_(own[run.pairs], spectra[run.layer])
    return total


def _tiled_plane(plane: Tensor, plan: Plan) -> Tensor:
    """A black plane that holds the windows of all blocks."""
    overlap = plan.grid.size - plan.grid.tile
    height, width = plan.grid.covered_height + overlap, plan.grid.covered_width + overlap
    return plane.new_zeros(*plane.shape[:2], height, width)


def _windows(plane: Tensor, plan: Plan, chunk: Chunk) -> Tensor:
    """Cut a chunk's windows out of a plane, which is black beyond its ends: (blocks, C, size, size) complex."""
    size, tile = plan.grid.size, plan.grid.tile
    images, rows, columns = chunk.extent
    height, width = (rows - 1) * tile + size, (2 * columns - 1) * tile + size
    part = plane[chunk.batch, :, chunk.y.start : chunk.y.start + height, chunk.x.start : chunk.x.start + width]
    if part.shape[-2:] != (height, width):
        part = torch.nn.functional.pad(part, (0, width - part.shape[-1], 0, height - part.shape[-2]))
    tiles = part.unfold(2, size, tile).unfold(3, size, tile).permute(0, 2, 3, 1, 4, 5)
    cut = plane.new_empty(images, rows, columns, plane.shape[1], size, size, dtype=plane.dtype.to_complex())
    return torch.complex(tiles[:, :, 0::2], tiles[:, :, 1::2], out=cut).flatten(0, 2)


def _add_windows(plane: Tensor, windows: Tensor, plan: Plan, chunk: Chunk) -> None:
    """Add a chunk's windows to a plane where :func:`_windows` cuts them: its transpose."""
    size, tile = plan.grid.size, plan.grid.tile
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


def _places(plan: Plan, chunk: Chunk, offset: int) -> list[Tensor]:
    """Where each of a chunk's pixels stands in the planes of its layers, for the first channel, counted in floats.

    A tile's first pixel stands at ``offset``, ``offset`` of its plane.
    """
    size, tile, device = plan.grid.size, plan.grid.tile, plan.place.device
    y = torch.arange(chunk.y.stop - chunk.y.start, device=device) % tile
    x = torch.arange(chunk.x.stop - chunk.x.start, device=device)
    inside = ((y + offset) * (2 * size))[:, None] + (2 * (x % tile + offset) + x // tile % 2)
    keys = plan.labels.terms(chunk.batch, chunk.y, chunk.x)
    return [plan.place.index_select(0, key.reshape(-1)).view(key.shape).add_(inside) for key in keys]


def _take(planes: Tensor, places: list[Tensor]) -> list[list[Tensor]]:
    """For each channel, take the pixels out of the planes of their layers."""
    flat = torch.view_as_real(planes).view(-1)
    step = 2 * planes.shape[-1] ** 2
    return [[flat[channel * step :].take(place) for place in places] for channel in range(planes.shape[1])]


def _put(values: Tensor, places: list[Tensor], plan: Plan, chunk: Chunk) -> Tensor:
    """Share each pixel out to the planes of its layers: (pairs, C, size, size) complex, the transpose of taking."""
    size, channels = plan.grid.size, values.shape[1]
    planes = values.new_zeros(len(chunk.block), channels, size, size, 2)
    flat = planes.view(-1)
    for channel in range(channels):
        own = flat[channel * 2 * size**2 :]
        light = values[chunk.pixels(channel)]
        if plan.labels.fraction is None:
            own.put_(places[0], light)
        else:
            shared = light * plan.labels.fraction[chunk.batch, chunk.y, chunk.x]
            own.put_(places[1], shared)
            own.put_(places[0], torch.where(places[0] == places[1], light, light - shared))
    return torch.view_as_complex(planes)


def _mix_into(mixed: Tensor, terms: list[list[Tensor]], plan: Plan, chunk: Chunk) -> None:
    """Write each pixel's mean over its layers into (B, C, H, W)."""
    for channel, own in enumerate(terms):
        if plan.labels.fraction is None:
            mixed[chunk.pixels(channel)] = own[0]
        else:
            torch.lerp(*own, plan.labels.fraction[chunk.batch, chunk.y, chunk.x], out=mixed[chunk.pixels(channel)])
