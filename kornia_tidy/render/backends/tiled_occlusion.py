"""Occlusion by tiles: of each tile's window, only the layers found there are blurred and laid over one another.

A tile of T x T pixels sees a window of ``size = T + P - 1``. A layer absent from the window has neither light nor
opacity there, so leaving it out changes nothing. What remains is made cheap:

- Light and weight of a layer go through the PSF together, as the real and imaginary part of one complex plane.
- The cumulative alpha of a window's nearest layer is the sum of its PSF, that of the farthest one is its own alpha.
  Only layers between the two need a third plane.
- A window of a single layer, the common case, hides nothing: it is one convolution in the image's own precision, two
  windows of like layers in one complex plane.

Tiles with as many layers as each other are worked on together, in chunks of bounded memory. For the backward pass only
the inputs are kept; each chunk is computed again.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad

from kornia_tidy.render.backend import GradientPairs, gradient_pairs, wants_gradient
from kornia_tidy.render.backends.dense_occlusion import (
    EPSILON,
    OcclusionPlanes,
    cumulative_weight,
    lay_over,
)
from kornia_tidy.render.backends.tile_plan import Grid, TileKind
from kornia_tidy.render.backends.window_plan import Corner, WindowChunk, WindowPlan, plan_windows
from kornia_tidy.render.layers import weight_of_layer
from kornia_tidy.render.scene import Labels


class Planes(NamedTuple):
    """The planes that windows are cut from, and the spectra of the PSFs.

    Args:
        light: (B, C, H', W') image, with all that lies beyond its border and below and right of its tiles.
        spectra: (D', C, size, size) complex128 spectra of the PSFs of the layers present.
        layer_weight: (B, H', W') weight of the next layer, or None.
        mean: (B, C) mean light of each image, and
        stray_light: (D', C) fraction of it that each layer takes on; or None.
        layer_index: (B, H', W').
        inside: (1, H', W') 1 on the image and 0 in the dark beyond it, or None for no dark.
    """

    light: Tensor
    spectra: Tensor
    layer_weight: Tensor | None
    mean: Tensor | None
    stray_light: Tensor | None
    layer_index: Tensor
    inside: Tensor | None


class Inputs(NamedTuple):
    """The differentiable inputs of a chunk's tiles: windows of the planes, and spectra of their layers."""

    light: Tensor  # (N, C, size, size)
    spectra: Tensor  # (N, n, C, size, size), or (N / 2, C, size, size) for pairs of one layer
    layer_weight: Tensor | None  # (N, size, size)
    mean: Tensor | None  # (N, C)
    stray_light: Tensor | None  # as spectra, without the size


def occlude_tiled(planes: OcclusionPlanes, labels: Labels, grid: Grid, kind: TileKind) -> Tensor:
    """Render with occlusion by tiles; the definition is :func:`~.dense_occlusion.occlude_dense`.

    Args:
        planes: of the scene.
        labels: the layers of the pixels of ``planes``.
        grid: of the tiles.
        kind: of the tiles.

    Returns:
        (B, C, H, W).
    """
    channels = planes.light.shape[1]
    plan = plan_windows(labels, len(planes.psfs), channels, grid, kind, dark=planes.inside is not None)
    padded = _padded(planes, plan)
    coded = planes.light.new_empty(*planes.light.shape[:2], grid.height, grid.width)
    for chunk in plan.chunks:
        tiles = _tiles(_inputs(padded, chunk, grid), padded, chunk, plan)
        for place, (image, y, x) in _kept(chunk):
            part = coded[image, :, y : y + grid.tile, x : x + grid.tile]
            part.copy_(tiles[place, :, : part.shape[-2], : part.shape[-1]])
    return coded


def occlusion_gradients(
    planes: OcclusionPlanes, labels: Labels, grid: Grid, kind: TileKind, gradient: Tensor
) -> GradientPairs:
    """Return the gradients of light rendered with occlusion, with respect to those planes that require them.

    Args:
        planes: of the scene.
        labels: the layers of the pixels of ``planes``.
        grid: of the tiles.
        kind: of the tiles.
        gradient: (B, C, H, W) of the rendered light.
    """
    channels = planes.light.shape[1]
    plan = plan_windows(labels, len(planes.psfs), channels, grid, kind, dark=planes.inside is not None)
    with torch.no_grad():
        found = _gradients(planes, plan, gradient, [wants_gradient(x) for x in planes[:5]])
    return gradient_pairs(planes[:5], found)


def _gradients(
    planes: OcclusionPlanes, plan: WindowPlan, grad: Tensor, wanted: Sequence[bool]
) -> tuple[Tensor | None, ...]:
    """Return the gradients with respect to light, PSFs, layer weight, mean and stray light, where they are wanted."""
    padded, grid = _padded(planes, plan), plan.grid
    grad = pad(grad, (0, grid.columns * grid.tile - grid.width, 0, grid.rows * grid.tile - grid.height))
    gradients = {
        name: torch.zeros_like(source, memory_format=torch.contiguous_format)
        for name, source, want in zip(Inputs._fields, padded[:5], wanted, strict=True)
        if want and source is not None
    }
    for chunk in plan.chunks:
        own = torch.stack([grad[i, :, y : y + grid.tile, x : x + grid.tile] for i, y, x in chunk.corners])
        own[chunk.fillers] = 0
        leaves = [
            None if x is None else x.detach().requires_grad_(want)
            for x, want in zip(_inputs(padded, chunk, grid), wanted, strict=True)
        ]
        asked = {n: x for n, x in zip(Inputs._fields, leaves, strict=True) if x is not None and x.requires_grad}
        if not asked:
            continue
        with torch.enable_grad():
            tiles = _tiles(Inputs._make(leaves), padded, chunk, plan)
        found = torch.autograd.grad(tiles, list(asked.values()), own.to(tiles.dtype))
        for name, part in zip(asked, found, strict=True):
            _add(name, gradients[name], part, chunk, grid)
    return _of_planes(gradients, planes, plan.present)


def _of_planes(gradients: dict[str, Tensor], planes: OcclusionPlanes, present: Tensor) -> tuple[Tensor | None, ...]:
    """Return the gradients of the scene's planes from those of the padded ones, cropped."""
    light, psfs, weight, _, stray_light, _, _ = planes
    of_psfs = of_stray_light = None
    if "spectra" in gradients:  # correlation is the transpose of convolution
        of_psfs = torch.zeros_like(psfs)
        own = torch.fft.ifft2(gradients["spectra"], norm="forward").real
        of_psfs[present] = own[..., : psfs.shape[-2], : psfs.shape[-1]].to(psfs.dtype)
    if "stray_light" in gradients and stray_light is not None:
        of_stray_light = torch.zeros_like(stray_light)
        of_stray_light[present] = gradients["stray_light"]
    of_light, of_weight = gradients.get("light"), gradients.get("layer_weight")
    if of_light is not None:
        of_light = of_light[..., : light.shape[-2], : light.shape[-1]]
    if of_weight is not None and weight is not None:
        of_weight = of_weight[..., : weight.shape[-2], : weight.shape[-1]].sum_to_size(weight.shape)
    return of_light, of_psfs, of_weight, gradients.get("mean"), of_stray_light


def _padded(planes: OcclusionPlanes, plan: WindowPlan) -> Planes:
    """Return planes as large as all tiles: where the last ones hang over there is nothing new to be computed."""
    light, psfs, weight, mean, stray_light, index, inside = planes
    grid, batch = plan.grid, len(light)
    rest = (0, grid.columns * grid.tile - grid.width, 0, grid.rows * grid.tile - grid.height)
    spectra = torch.fft.fft2(psfs.index_select(0, plan.present).double(), s=(grid.size, grid.size))
    return Planes(
        pad(light, rest, mode="replicate"),
        spectra,
        None if weight is None else pad(weight, rest, mode="replicate").expand(batch, -1, -1),
        mean,
        None if stray_light is None else stray_light.index_select(0, plan.present),
        pad(index.to(light.dtype), rest, mode="replicate").long().expand(batch, -1, -1),
        None if inside is None else pad(inside, rest, mode="replicate"),
    )


def _cut(planes: Tensor, chunk: WindowChunk, grid: Grid) -> Tensor:
    """Cut a chunk's windows out of (B, ..., H', W')."""
    size = grid.size
    return torch.stack([planes[image, ..., y : y + size, x : x + size] for image, y, x in chunk.corners])


def _kept(chunk: WindowChunk) -> Iterator[tuple[int, Corner]]:
    """Yield the tiles that count, with their places in the chunk."""
    for place, corner in enumerate(chunk.corners):
        if place not in chunk.fillers:
            yield place, corner


def _inputs(planes: Planes, chunk: WindowChunk, grid: Grid) -> Inputs:
    alone = chunk.single_layer
    layers = chunk.layers[::2, 0] if alone else chunk.layers
    images = [image for image, _, _ in chunk.corners]
    return Inputs(
        _cut(planes.light, chunk, grid),
        planes.spectra.index_select(0, layers.flatten()).unflatten(0, layers.shape),
        None if alone or planes.layer_weight is None else _cut(planes.layer_weight, chunk, grid),
        None if planes.mean is None else planes.mean[images],
        None if planes.stray_light is None else planes.stray_light[layers],
    )


def _add(name: str, gradient: Tensor, part: Tensor, chunk: WindowChunk, grid: Grid) -> None:
    """Add the gradient of a chunk's input to the gradient of its source."""
    if name in ("light", "layer_weight"):
        for own, (image, y, x) in zip(part, chunk.corners, strict=True):
            gradient[image, ..., y : y + grid.size, x : x + grid.size] += own
        return
    if name == "mean":
        taken = torch.tensor([image for image, _, _ in chunk.corners], device=gradient.device)
    else:
        taken = chunk.layers[::2, 0] if chunk.single_layer else chunk.layers.flatten()
    gradient.index_add_(0, taken, part.reshape(-1, *gradient.shape[1:]))


def _tiles(inputs: Inputs, planes: Planes, chunk: WindowChunk, plan: WindowPlan) -> Tensor:
    """Return a chunk's tiles, (N, C, tile, tile)."""
    return _pairs_of_one_layer(inputs, plan.grid) if chunk.single_layer else _layers_over(inputs, planes, chunk, plan)


def _pairs_of_one_layer(inputs: Inputs, grid: Grid) -> Tensor:
    light, spectra = inputs.light.unflatten(0, (-1, 2)), inputs.spectra  # (N / 2, 2, C, ...) and (N / 2, C, ...)
    if inputs.stray_light is not None and inputs.mean is not None:
        mean, stray_light = inputs.mean.unflatten(0, (-1, 2)), inputs.stray_light[:, None]
        light = torch.lerp(light, mean[..., None, None], stray_light[..., None, None])
    both = torch.complex(light[:, 0], light[:, 1])
    blurred = torch.fft.ifft2(torch.fft.fft2(both) * spectra.to(both.dtype))
    normaliser = spectra[..., :1, :1].real.to(light.dtype) + EPSILON  # the sum of the PSF
    start = grid.size - grid.tile
    blurred = torch.view_as_real(blurred[..., start:, start:]).movedim(-1, 1) / normaliser[:, None]
    return blurred.flatten(0, 1)


def _layers_over(inputs: Inputs, planes: Planes, chunk: WindowChunk, plan: WindowPlan) -> Tensor:
    grid = plan.grid
    start, count = grid.size - grid.tile, chunk.layers.shape[1]
    layers = plan.present[chunk.layers][..., None, None]
    layer_index = _cut(planes.layer_index, chunk, grid)[:, None]
    layer_weight = None if inputs.layer_weight is None else inputs.layer_weight[:, None].double()
    # Of the nearest layer it is the sum of the PSF, of the farthest one its own alpha; those between need a plane.
    between = slice(1, count - 1 if chunk.bounded else count)
    alpha = weight_of_layer(layer_index, layer_weight, layers).double()
    cumulative = cumulative_weight(layer_index, layer_weight, layers[:, between]).double()
    if planes.inside is not None:
        inside = torch.stack([planes.inside[0, y : y + grid.size, x : x + grid.size] for _, y, x in chunk.corners])
        alpha, cumulative = alpha * inside[:, None], cumulative * inside[:, None]

    light = inputs.light[:, None].double()
    if inputs.stray_light is not None and inputs.mean is not None:  # both or none
        mean, stray_light = inputs.mean[:, None, :, None, None].double(), inputs.stray_light[..., None, None].double()
        light = torch.lerp(light, mean, stray_light)
    lit = torch.complex(light, torch.ones_like(light))  # times a weight: the layer's light, and the weight itself
    spectra = torch.fft.fft2(alpha[:, :, None].to(lit.dtype) * lit)
    spectra = spectra * inputs.spectra if torch.is_grad_enabled() else spectra.mul_(inputs.spectra)
    blurred = torch.fft.ifft2(spectra)[..., start:, start:]

    cumulative_alpha = [blurred.imag[:, 0]]
    if cumulative.shape[1]:
        spectra = torch.fft.rfft2(cumulative)[:, :, None] * inputs.spectra[:, between, ..., : grid.size // 2 + 1]
        cumulative_alpha += torch.fft.irfft2(spectra, s=(grid.size, grid.size))[..., start:, start:].unbind(1)
    if chunk.bounded:
        cumulative_alpha.append(inputs.spectra[:, -1, :, :1, :1].real)  # the sum of the PSF
    return lay_over((blurred.real[:, d], blurred.imag[:, d], cumulative_alpha[d]) for d in reversed(range(count)))
