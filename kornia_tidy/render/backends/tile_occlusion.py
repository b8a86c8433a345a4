r"""Occlusion by tiles: of each block's windows, the layers found there are laid over one another.

A layer absent from the windows has neither light nor opacity there, so leaving it out changes nothing. The planes of
:mod:`kornia_tidy.render.backends.dense_occlusion` are laid over one another from far to near:

.. math:: R_d = l_d s_d + (1 - a_d s_d) R_{d-1}, \qquad s_d = \frac{1}{\max(E_d, 0) + \epsilon}

For the backward pass only the inputs are kept: each chunk is computed again, and autograd differentiates it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from kornia_tidy.kernels.precision import widest
from kornia_tidy.render.backend import GradientPairs, gradient_pairs, wants_gradient
from kornia_tidy.render.backends.dense_occlusion import EPSILON, OcclusionPlanes, cumulative_weight
from kornia_tidy.render.backends.tiles import Chunk, Plan, part_of, windows
from kornia_tidy.render.backends.whole_occlusion import EPSILON_FLOAT32
from kornia_tidy.render.layers import weight_of_layer


class _Inputs(NamedTuple):
    """Inputs of a chunk, and those with gradients. Each tensor of a pair is that of its layer."""

    light: Tensor  # (b, C, h, w) part of the plane
    spectra: Tensor  # (K, C, height, width) of the PSFs
    layer_weight: Tensor | None  # (b, h, w)
    mean: Tensor | None  # (b, C)
    stray_light: Tensor | None  # (K, C)


def occlude_tiles(planes: OcclusionPlanes, plan: Plan) -> Tensor:
    """Render with occlusion; the definition is :func:`~.dense_occlusion.occlude_dense`.

    Args:
        planes: of the scene.
        plan: of windows, see :func:`kornia_tidy.render.backends.tiles.plan_pairs`.

    Returns:
        (B, C, H, W) in float64, or in float32 where the device has nothing wider.
    """
    sources = _sources(planes, plan)
    coded = sources.spectra.real.new_empty(*planes.light.shape[:2], *plan.grid.shape)
    for chunk in plan.chunks:
        images, y, x = chunk.pixels
        coded[images, :, y, x] = _rendered(_inputs(sources, chunk, plan), planes, chunk, plan)
    return coded


def tile_gradients(planes: OcclusionPlanes, plan: Plan, gradient: Tensor) -> GradientPairs:
    """Return the gradients of light rendered with occlusion, with respect to those planes that require them.

    Args:
        planes: of the scene.
        plan: as for :func:`occlude_tiles`.
        gradient: (B, C, H, W) of the rendered light.
    """
    with torch.no_grad():
        sources = _sources(planes, plan)
    wanted = [wants_gradient(x) for x in planes[:5]]
    totals = [torch.zeros_like(x) if want and x is not None else None for x, want in zip(sources, wanted, strict=True)]
    for chunk in plan.chunks:
        images, y, x = chunk.pixels
        parts = zip(_inputs(sources, chunk, plan), wanted, strict=True)
        leaves = [None if part is None else part.detach().requires_grad_(want) for part, want in parts]
        asked = [leaf for leaf in leaves if leaf is not None and leaf.requires_grad]
        if not asked:
            break
        with torch.enable_grad():
            tiles = _rendered(_Inputs._make(leaves), planes, chunk, plan)
        found = iter(torch.autograd.grad(tiles, asked, gradient[images, :, y, x].to(tiles.dtype)))
        for name, total in zip(_Inputs._fields, totals, strict=True):
            if total is None:
                continue
            part = next(found)
            if name in ("spectra", "stray_light"):
                total.index_add_(0, chunk.layer, part)
            elif name == "mean":
                total[images] += part
            else:
                own = total[images, ..., y.start : y.start + part.shape[-2], x.start : x.start + part.shape[-1]]
                own += part[..., : own.shape[-2], : own.shape[-1]]
    return gradient_pairs(planes[:5], _of_planes(totals, planes, plan))


def _of_planes(totals: list[Tensor | None], planes: OcclusionPlanes, plan: Plan) -> list[Tensor | None]:
    """Return the gradients of the scene's planes from those of :func:`_sources`."""
    light, spectra, weight, mean, stray_light = totals
    side, of_psfs = planes.psfs.shape[-1], None
    if spectra is not None:  # correlation is the transpose of convolution
        own = torch.fft.ifft2(spectra, norm="forward").real[..., :side, :side].to(planes.psfs.dtype)
        of_psfs = torch.zeros_like(planes.psfs).index_copy_(0, plan.layers, own)
    if stray_light is not None and planes.stray_light is not None:
        stray_light = torch.zeros_like(planes.stray_light).index_copy_(0, plan.layers, stray_light)
    if weight is not None and planes.layer_weight is not None:
        weight = weight.sum_to_size(planes.layer_weight.shape)
    return [light, of_psfs, weight, mean, stray_light]


def _sources(planes: OcclusionPlanes, plan: Plan) -> _Inputs:
    """Return the whole planes, and spectra and stray light of the plan's layers, without gradients."""
    light, psfs, weight, mean, stray_light = (None if x is None else x.detach() for x in planes[:5])
    assert light is not None
    assert psfs is not None
    return _Inputs(
        light,
        torch.fft.fft2(psfs.index_select(0, plan.layers).to(widest(psfs.device)), s=plan.grid.size),
        None if weight is None else weight.expand(len(light), -1, -1),
        mean,
        None if stray_light is None else stray_light.index_select(0, plan.layers),
    )


def _inputs(sources: _Inputs, chunk: Chunk, plan: Plan) -> _Inputs:
    light, spectra, weight, mean, stray_light = sources
    return _Inputs(
        part_of(light, chunk, plan.grid),
        spectra.index_select(0, chunk.layer),
        None if weight is None else part_of(weight, chunk, plan.grid),
        None if mean is None else mean[chunk.pixels[0]],
        None if stray_light is None else stray_light.index_select(0, chunk.layer),
    )


def _rendered(given: _Inputs, planes: OcclusionPlanes, chunk: Chunk, plan: Plan) -> Tensor:
    """Return a chunk's pixels, (b, C, h, w)."""
    grid, spectra, blocks, batch = plan.grid, given.spectra, math.prod(chunk.extent), len(planes.light)
    dtype, last = spectra.real.dtype, grid.lost

    def of_pairs(part: Tensor) -> Tensor:
        return windows(part, grid).index_select(0, chunk.block)

    def blurred(part: Tensor) -> Tensor:
        """Return (K, n, C, down, across, 2) of (K, n, C or 1, height, width, 2)."""
        product = torch.fft.fft2(torch.view_as_complex(part))
        product = product.mul_(spectra[:, None]) if part.shape[2] > 1 else product * spectra[:, None]
        return torch.view_as_real(torch.fft.ifft2(product)[..., last:, last:])

    light = of_pairs(given.light.to(dtype))
    if given.mean is not None and given.stray_light is not None:  # both or none
        images = chunk.block // (blocks // len(given.mean))
        mean, stray_light = given.mean.index_select(0, images).to(dtype), given.stray_light.to(dtype)
        light = torch.lerp(light, mean[..., None, None, None], stray_light[..., None, None, None])
    epsilon = EPSILON if dtype == torch.float64 else EPSILON_FLOAT32
    if len(chunk.layer) == blocks and planes.inside is None:  # of one layer: its alpha is the sum of the PSF
        normaliser = spectra[..., 0, 0].real[..., None, None, None] + epsilon
        return _image(blurred(light[:, None])[:, 0] / normaliser, chunk)
    layers = plan.layers[chunk.layer].int()[:, None, None, None]
    index = of_pairs(part_of(planes.layer_index.int().expand(batch, -1, -1), chunk, grid))
    weight = None if given.layer_weight is None else of_pairs(given.layer_weight)
    alphas = [weight_of_layer(index, weight, layers), cumulative_weight(index, weight, layers)]
    alpha = torch.stack(alphas, 1).to(dtype)  # and cumulative alpha, (K, 2, height, width, 2)
    if planes.inside is not None:
        alpha = alpha * of_pairs(part_of(planes.inside.expand(batch, -1, -1), chunk, grid))[:, None]
    light = blurred((alpha[:, :1] * light)[:, None])[:, 0]
    own, cumulative = blurred(alpha[:, :, None]).unbind(1)
    scale = cumulative.clamp(min=0).add_(epsilon).reciprocal_()
    shown, passed = light * scale, torch.addcmul(scale.new_ones(()), own, scale, value=-1)
    layered = zip(*(x.split(chunk.counts) for x in (shown, passed)), strict=True)  # block by block, or all at once
    alike = blocks // len(chunk.counts), -1
    tiles = [_laid_over(own.unflatten(0, alike), through.unflatten(0, alike)) for own, through in layered]
    return _image(torch.cat(tiles), chunk)


def _laid_over(shown: Tensor, passed: Tensor) -> Tensor:
    """Return the layers (blocks, n, ...) of some blocks over one another, given from far to near."""
    behind, *nearer = shown.unbind(1)
    for own, through in zip(nearer, passed.unbind(1)[1:], strict=True):
        behind = torch.addcmul(own, through, behind)
    return behind


def _image(tiles: Tensor, chunk: Chunk) -> Tensor:
    """Put tiles (blocks, C, down, across, 2) together, and cut off what reaches beyond the plane."""
    whole = tiles.unflatten(0, chunk.extent).permute(0, 3, 1, 4, 2, 6, 5).flatten(4, 6).flatten(2, 3)
    _, y, x = chunk.pixels
    return whole[..., : y.stop - y.start, : x.stop - x.start]
