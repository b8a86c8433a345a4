"""Exact occlusion by tiles: of each tile's window, only the layers found there are blurred and laid over one another.

A tile of T x T pixels sees a window of ``size = T + P - 1``. A layer absent from the window has neither light nor
opacity there, so leaving it out changes nothing. What remains is made cheap:

- Light and weight of a layer go through the PSF together, as the real and imaginary part of one complex plane.
- The nearest layer of a window is seen against all of it, so its divisor is the sum of its PSF; the farthest one only
  against itself, so its divisor is its own blurred weight. Only layers between the two need a third plane.
- A window of a single layer, the common case, hides nothing: it is one convolution in the image's own precision, two
  windows of like layers in one complex plane.

Tiles with as many layers as each other are worked on together, in chunks of bounded memory. For the backward pass only
the inputs are kept; each chunk is computed again.

Small PSFs are convolved directly instead where that takes less time, see
:mod:`kornia_tidy.render.backends.direct_occlusion`; gradients are made by tiles all the same.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from kornia_tidy.render.backends.allocator import keep_memory
from kornia_tidy.render.backends.dense_occlusion import EPSILON, lay_over, occlude_planes, weight_behind
from kornia_tidy.render.backends.direct_occlusion import goes_directly, occlude_directly
from kornia_tidy.render.backends.occlusion_tile_plan import Chunk, Corner, Grid, Plan, make_plan
from kornia_tidy.render.backends.summed import differentiable_slopes
from kornia_tidy.render.borders import pad_border
from kornia_tidy.render.layers import layer_weight
from kornia_tidy.render.stray_light import normalised_share


class Scene(NamedTuple):
    """Planes that windows are cut from, and what their layers are blurred by.

    Args:
        light: (B, C, H', W') image, with all that lies beyond its border and below and right of its tiles.
        spectra: (D', C, size, size) complex128 spectra of the PSFs of the layers present.
        lower: (B, H', W') index of each pixel's layer.
        fraction: (B, H', W') share of the next layer, or None.
        inside: (1, H', W') 1 on the image and 0 in the dark beyond it, or None for no dark.
        mean: (B, C) mean light of each image, and
        veil: (D', C) how much of it each layer takes on; or None.
    """

    light: Tensor
    spectra: Tensor
    lower: Tensor
    fraction: Tensor | None
    inside: Tensor | None
    mean: Tensor | None
    veil: Tensor | None


class Inputs(NamedTuple):
    """What a chunk's tiles are a differentiable function of: windows of the scene, and spectra of their layers."""

    light: Tensor  # (N, C, size, size)
    spectra: Tensor  # (N, n, C, size, size), or (N / 2, C, size, size) for pairs of one layer
    fraction: Tensor | None  # (N, size, size)
    mean: Tensor | None  # (N, C)
    veil: Tensor | None  # as spectra, without the size


def occlude_tiled(
    image: Tensor, lower: Tensor, fraction: Tensor | None, psfs: Tensor, *, veil: Tensor | None, border: str
) -> Tensor:
    """Render with occlusion, by tiles or directly.

    The definition is :func:`kornia_tidy.render.backends.dense_occlusion.occlude_dense`.

    It has gradients with respect to image, psfs, fraction and veil; where they are differentiated in turn, they are
    made by :func:`kornia_tidy.render.backends.dense_occlusion.occlude_planes`.
    """
    psf_size = psfs.shape[-1]
    sloped = fraction is not None and fraction.requires_grad and torch.is_grad_enabled()
    keep_memory()

    # Black beyond the border has no weight; let it lie in layers that are there anyway.
    sides = "replicate" if border == "zero" else border
    radius = psf_size // 2
    lower = pad_border(lower.to(image.dtype), radius, sides)[:, 0]
    fraction = None if fraction is None else pad_border(fraction, radius, sides)[:, 0]
    inside = pad_border(torch.ones_like(image[:1, 0]), radius, "zero") if border == "zero" else None
    light = pad_border(image, radius, border)
    mean = None if veil is None else image.mean((-2, -1))
    veil = None if veil is None else normalised_share(veil, psfs, image.shape[-2:], border)
    planes = light, psfs, fraction, mean, veil, lower, inside
    return _Occlude.apply(*planes, sloped, goes_directly(light, psfs, lower, fraction))


def _plan(
    light: Tensor, psfs: Tensor, lower: Tensor, fraction: Tensor | None, inside: Tensor | None, *, sloped: bool
) -> Plan:
    (batch, channels), psf_size = light.shape[:2], psfs.shape[-1]
    return make_plan(
        lower.long().expand(batch, -1, -1),
        None if fraction is None else fraction.detach().expand(batch, -1, -1),
        (light.shape[-2] - psf_size + 1, light.shape[-1] - psf_size + 1),
        (len(psfs), channels, psf_size),
        sloped=sloped,
        dark=inside is not None,
    )


class _Occlude(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        light: Tensor,
        psfs: Tensor,
        fraction: Tensor | None,
        mean: Tensor | None,
        veil: Tensor | None,
        lower: Tensor,
        inside: Tensor | None,
        sloped: bool,
        directly: bool,
    ) -> Tensor:
        ctx.save_for_backward(light, psfs, fraction, mean, veil, lower, inside)
        ctx.sloped, ctx.plan = sloped, None
        if directly:
            return occlude_directly(light, psfs, lower, fraction, mean, veil, inside)
        plan = ctx.plan = _plan(light, psfs, lower, fraction, inside, sloped=sloped)
        scene = _scene(light, psfs, fraction, mean, veil, lower, inside, plan)
        grid = plan.grid
        coded = light.new_empty(*light.shape[:2], grid.height, grid.width)
        for chunk in plan.chunks:
            tiles = _tiles(_inputs(scene, chunk, grid), scene, chunk, plan)
            for place, (image, y, x) in _kept(chunk):
                part = coded[image, :, y : y + grid.tile, x : x + grid.tile]
                part.copy_(tiles[place, :, : part.shape[-2], : part.shape[-1]])
        return coded

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        (grad,), wanted, saved = grad_outputs, ctx.needs_input_grad[:5], ctx.saved_tensors
        light, psfs, fraction, _, _, lower, inside = saved
        if torch.is_grad_enabled():  # it is differentiated in turn
            render = partial(occlude_planes, lower=lower.long(), inside=inside)
            return *differentiable_slopes(render, saved[:5], grad, wanted), None, None, None, None
        plan = ctx.plan or _plan(light, psfs, lower, fraction, inside, sloped=ctx.sloped)
        return *_slopes(saved, plan, grad, wanted), None, None, None, None


def _slopes(
    saved: Sequence[Tensor | None], plan: Plan, grad: Tensor, wanted: Sequence[bool]
) -> tuple[Tensor | None, ...]:
    """Return the gradients with respect to light, psfs, fraction, mean and veil, where they are wanted."""
    light, psfs, fraction, mean, veil, lower, inside = saved
    assert light is not None
    assert psfs is not None
    assert lower is not None
    grid = plan.grid
    scene = _scene(light, psfs, fraction, mean, veil, lower, inside, plan)
    grad = pad(grad, (0, grid.columns * grid.tile - grid.width, 0, grid.rows * grid.tile - grid.height))
    slopes = {
        name: torch.zeros_like(source, memory_format=torch.contiguous_format)
        for name, source, want in zip(
            Inputs._fields, (scene.light, scene.spectra, scene.fraction, scene.mean, scene.veil), wanted, strict=True
        )
        if want and source is not None
    }
    for chunk in plan.chunks:
        own = torch.stack([grad[i, :, y : y + grid.tile, x : x + grid.tile] for i, y, x in chunk.corners])
        own[chunk.fillers] = 0
        leaves = [
            None if x is None else x.detach().requires_grad_(want)
            for x, want in zip(_inputs(scene, chunk, grid), wanted, strict=True)
        ]
        asked = {n: x for n, x in zip(Inputs._fields, leaves, strict=True) if x is not None and x.requires_grad}
        if not asked:
            continue
        with torch.enable_grad():
            tiles = _tiles(Inputs._make(leaves), scene, chunk, plan)
        found = torch.autograd.grad(tiles, list(asked.values()), own.to(tiles.dtype))
        for name, part in zip(asked, found, strict=True):
            _add(name, slopes[name], part, chunk, grid)
    of_psfs = of_veil = None
    if "spectra" in slopes:  # correlation is the transpose of convolution
        of_psfs = torch.zeros_like(psfs)
        own = torch.fft.ifft2(slopes["spectra"], norm="forward").real
        of_psfs[plan.present] = own[..., : psfs.shape[-2], : psfs.shape[-1]].to(psfs.dtype)
    if "veil" in slopes and veil is not None:
        of_veil = torch.zeros_like(veil)
        of_veil[plan.present] = slopes["veil"]
    of_light, of_fraction = slopes.get("light"), slopes.get("fraction")
    # What hangs over is not seen by any pixel of the image.
    if of_light is not None:
        of_light = of_light[..., : light.shape[-2], : light.shape[-1]]
    if of_fraction is not None and fraction is not None:
        of_fraction = of_fraction[..., : fraction.shape[-2], : fraction.shape[-1]].sum_to_size(fraction.shape)
    return of_light, of_psfs, of_fraction, slopes.get("mean"), of_veil


def _scene(
    light: Tensor,
    psfs: Tensor,
    fraction: Tensor | None,
    mean: Tensor | None,
    veil: Tensor | None,
    lower: Tensor,
    inside: Tensor | None,
    plan: Plan,
) -> Scene:
    """Let the last tiles hang over: nothing new is there that would have to be computed."""
    grid, batch = plan.grid, len(light)
    rest = (0, grid.columns * grid.tile - grid.width, 0, grid.rows * grid.tile - grid.height)
    light = pad(light, rest, mode="replicate")
    fraction = None if fraction is None else pad(fraction, rest, mode="replicate").expand(batch, -1, -1)
    lower = pad(lower, rest, mode="replicate").long().expand(batch, -1, -1)
    inside = None if inside is None else pad(inside, rest, mode="replicate")
    spectra = torch.fft.fft2(psfs.index_select(0, plan.present).double(), s=(plan.grid.size, plan.grid.size))
    veil = None if veil is None else veil.index_select(0, plan.present)
    return Scene(light, spectra, lower, fraction, inside, mean, veil)


def _cut(planes: Tensor, chunk: Chunk, grid: Grid) -> Tensor:
    """Cut a chunk's windows out of (B, ..., H', W')."""
    size = grid.size
    return torch.stack([planes[image, ..., y : y + size, x : x + size] for image, y, x in chunk.corners])


def _kept(chunk: Chunk) -> Iterator[tuple[int, Corner]]:
    """The tiles that count."""
    for place, corner in enumerate(chunk.corners):
        if place not in chunk.fillers:
            yield place, corner


def _alone(chunk: Chunk) -> bool:
    """Whether each window is all of one layer, and tiles stand in pairs."""
    return chunk.bounded and chunk.layers.shape[1] == 1


def _inputs(scene: Scene, chunk: Chunk, grid: Grid) -> Inputs:
    alone = _alone(chunk)
    layers = chunk.layers[::2, 0] if alone else chunk.layers
    images = [image for image, _, _ in chunk.corners]
    return Inputs(
        _cut(scene.light, chunk, grid),
        scene.spectra.index_select(0, layers.flatten()).unflatten(0, layers.shape),
        None if alone or scene.fraction is None else _cut(scene.fraction, chunk, grid),
        None if scene.mean is None else scene.mean[images],
        None if scene.veil is None else scene.veil[layers],
    )


def _add(name: str, slope: Tensor, part: Tensor, chunk: Chunk, grid: Grid) -> None:
    """Add the gradient of one of a chunk's inputs to that of what it was taken from."""
    if name in ("light", "fraction"):
        for own, (image, y, x) in zip(part, chunk.corners, strict=True):
            slope[image, ..., y : y + grid.size, x : x + grid.size] += own
        return
    if name == "mean":
        taken = torch.tensor([image for image, _, _ in chunk.corners], device=slope.device)
    else:
        taken = chunk.layers[::2, 0] if _alone(chunk) else chunk.layers.flatten()
    slope.index_add_(0, taken, part.reshape(-1, *slope.shape[1:]))


def _tiles(inputs: Inputs, scene: Scene, chunk: Chunk, plan: Plan) -> Tensor:
    """Return a chunk's tiles, (N, C, tile, tile)."""
    return _pairs_of_one_layer(inputs, plan.grid) if _alone(chunk) else _layers_over(inputs, scene, chunk, plan)


def _pairs_of_one_layer(inputs: Inputs, grid: Grid) -> Tensor:
    light, spectra = inputs.light.unflatten(0, (-1, 2)), inputs.spectra  # (N / 2, 2, C, ...) and (N / 2, C, ...)
    if inputs.veil is not None and inputs.mean is not None:
        mean, veil = inputs.mean.unflatten(0, (-1, 2)), inputs.veil[:, None]
        light = torch.lerp(light, mean[..., None, None], veil[..., None, None])
    both = torch.complex(light[:, 0], light[:, 1])
    blurred = torch.fft.ifft2(torch.fft.fft2(both) * spectra.to(both.dtype))
    divisor = spectra[..., :1, :1].real.to(light.dtype) + EPSILON  # the sum of the PSF
    start = grid.size - grid.tile
    blurred = torch.view_as_real(blurred[..., start:, start:]).movedim(-1, 1) / divisor[:, None]
    return blurred.flatten(0, 1)


def _layers_over(inputs: Inputs, scene: Scene, chunk: Chunk, plan: Plan) -> Tensor:
    grid = plan.grid
    start, count = grid.size - grid.tile, chunk.layers.shape[1]
    index = plan.present[chunk.layers][..., None, None]
    lower = _cut(scene.lower, chunk, grid)[:, None]
    fraction = None if inputs.fraction is None else inputs.fraction[:, None].double()
    # The nearest layer is seen against all of the window, the farthest one against itself; these need a plane.
    between = slice(1, count - 1 if chunk.bounded else count)
    own = layer_weight(lower, fraction, index).double()
    behind = weight_behind(lower, fraction, index[:, between]).double()
    if scene.inside is not None:
        inside = torch.stack([scene.inside[0, y : y + grid.size, x : x + grid.size] for _, y, x in chunk.corners])
        own, behind = own * inside[:, None], behind * inside[:, None]

    light = inputs.light[:, None].double()
    if inputs.veil is not None and inputs.mean is not None:  # both or none
        light = torch.lerp(light, inputs.mean[:, None, :, None, None].double(), inputs.veil[..., None, None].double())
    lit = torch.complex(light, torch.ones_like(light))  # times a weight: the layer's light, and the weight itself
    spectra = torch.fft.fft2(own[:, :, None].to(lit.dtype) * lit)
    spectra = spectra * inputs.spectra if torch.is_grad_enabled() else spectra.mul_(inputs.spectra)
    blurred = torch.fft.ifft2(spectra)[..., start:, start:]

    seen = [blurred.imag[:, 0]]
    if behind.shape[1]:
        spectra = torch.fft.rfft2(behind)[:, :, None] * inputs.spectra[:, between, ..., : grid.size // 2 + 1]
        seen += torch.fft.irfft2(spectra, s=(grid.size, grid.size))[..., start:, start:].unbind(1)
    if chunk.bounded:
        seen.append(inputs.spectra[:, -1, :, :1, :1].real)  # the sum of the PSF
    return lay_over((blurred.real[:, d], blurred.imag[:, d], seen[d]) for d in reversed(range(count)))
