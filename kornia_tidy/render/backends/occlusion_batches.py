r"""Occlusion in batches of transforms: all layers of a part of the scene at once.

The planes of :mod:`kornia_tidy.render.backends.dense_occlusion`, laid over one another by a product over the layers
instead of one after the other:

.. math:: I = \sum_d l_d s_d T_d, \qquad s_d = \frac{1}{\max(E_d, 0) + \epsilon}, \qquad
    T_d = \prod_{j > d} (1 - a_j s_j)

Its gradients need what shines through from behind each layer, :math:`R_{d+1} = l_d s_d + (1 - a_d s_d) R_d`:
:math:`\partial I / \partial l_d = s_d T_d`, :math:`\partial I / \partial a_d = -s_d T_d R_d` and
:math:`\partial I / \partial E_d = -s_d^2 T_d (l_d - a_d R_d)`.

On a device without float64 transforms are made in float32, and :math:`\epsilon` is 1e-3, as in Ikoma et al. 2021: the
round-off of a transform, some 1e-7, is divided by no less.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kornia_tidy.kernels.precision import widest
from kornia_tidy.render.backend import GradientPairs, gradient_pairs, wants_gradient
from kornia_tidy.render.backends.dense_occlusion import EPSILON, OcclusionPlanes, cumulative_weight
from kornia_tidy.render.backends.layer_batches import Part
from kornia_tidy.render.borders import from_spectrum, next_fast_size, to_spectrum
from kornia_tidy.render.layers import weight_of_layer

EPSILON_FLOAT32 = 1e-3  # as in the source: on devices without float64 round-off is some 1e-7 of the light


class _Layers(NamedTuple):
    """Inputs of the blur: light (B, D, C, H', W'), and alpha and cumulative alpha of the layers, (B, D, 2, H', W')."""

    light: Tensor
    alphas: Tensor


def part_of(planes: OcclusionPlanes, part: Part) -> OcclusionPlanes:
    """Return the planes that a part of the output is rendered from, with the layers in them."""
    lost, layers = planes.psfs.shape[-1] - 1, len(planes.psfs)
    weight, mean, stray, inside = planes.layer_weight, planes.mean, planes.stray_light, planes.inside
    return OcclusionPlanes(
        part.window(planes.light, lost),
        part.chosen(planes.psfs),
        None if weight is None else part.window(weight, lost),
        None if mean is None else mean[part.images],
        None if stray is None else part.chosen(stray),
        part.numbered(part.window(planes.layer_index, lost), layers),
        None if inside is None else part.window(inside, lost),
    )


def occlude_parts(planes: OcclusionPlanes, parts: list[Part], part_bytes: int) -> Tensor:
    """Render parts with occlusion; the arguments and the result are those of :func:`occlude`."""
    if len(parts) == 1 and parts[0].layers is None:
        return occlude(planes, part_bytes)
    lost = planes.psfs.shape[-1] - 1
    height, width = (side - lost for side in planes.light.shape[-2:])
    coded = planes.light.new_empty(*planes.light.shape[:2], height, width, dtype=_dtype(planes))
    for part in parts:
        coded[part.images, :, part.rows, part.columns] = occlude(part_of(planes, part), part_bytes)
    return coded


def part_gradients(planes: OcclusionPlanes, parts: list[Part], gradient: Tensor, part_bytes: int) -> GradientPairs:
    """Return the gradients of the planes, each part's made and added where it belongs.

    Args:
        planes: of the scene.
        parts: of the output.
        gradient: (B, C, H, W) of the rendered light.
        part_bytes: as for :func:`occlude`.
    """
    if len(parts) == 1 and parts[0].layers is None:
        return gradients(planes, gradient, part_bytes)
    lost = planes.psfs.shape[-1] - 1
    totals = [torch.zeros_like(x) if x is not None and x.requires_grad else None for x in planes]
    for part in parts:
        given = part_of(planes, part)
        own = given._replace(
            **{
                name: value.detach().requires_grad_()
                for name, value, total in zip(planes._fields, given, totals, strict=True)
                if total is not None and value is not None
            }
        )
        pairs = gradients(own, part.window(gradient), part_bytes)
        made, grads = zip(*pairs, strict=True)
        leaves = [x for x, total in zip(own, totals, strict=True) if total is not None and x is not None]
        found = iter(torch.autograd.grad(made, leaves, grads, allow_unused=True))
        for name, total in zip(planes._fields, totals, strict=True):
            if total is None or (value := next(found)) is None:
                continue
            if name in ("psfs", "stray_light"):
                total.index_add_(0, part.layers, value) if part.layers is not None else total.add_(value)
            elif name == "mean":
                total[part.images] += value
            else:
                part.window(total, lost).add_(value)
    return gradient_pairs(planes, totals)


def occlude(planes: OcclusionPlanes, part_bytes: int) -> Tensor:
    """Render with occlusion; the definition is :func:`~.dense_occlusion.occlude_dense`.

    Args:
        planes: of the scene.
        part_bytes: that a plane of all layers of the images and channels worked on together may take.

    Returns:
        (B, C, H, W) in float64, or in float32 where the device has nothing wider.
    """
    size, side, dtype = (planes.light.shape[-2], planes.light.shape[-1]), planes.psfs.shape[-1], _dtype(planes)
    rows, columns = size[0] - side + 1, size[1] - side + 1
    coded = torch.empty(*planes.light.shape[:2], rows, columns, dtype=dtype, device=planes.light.device)
    for images, channels in _parts(planes, part_bytes):
        layers = _layers(planes, images)
        alphas = to_spectrum(layers.alphas, size)
        for part in channels:
            blurred = _blurred(to_spectrum(layers.light[:, :, part], size), alphas, planes.psfs[:, part], size)
            coded[images, part] = _laid_over(*blurred)[0]
    return coded


def gradients(planes: OcclusionPlanes, gradient: Tensor, part_bytes: int) -> GradientPairs:
    """Return the gradients of light rendered with occlusion: of the PSFs, and of the layers' light and alpha.

    Args:
        planes: of the scene.
        gradient: (B, C, H, W) of the rendered light.
        part_bytes: as for :func:`occlude`.
    """
    size, side = (planes.light.shape[-2], planes.light.shape[-1]), planes.psfs.shape[-1]
    of_psfs = torch.zeros_like(planes.psfs) if wants_gradient(planes.psfs) else None
    pairs: GradientPairs = []
    for images, channels in _parts(planes, part_bytes):
        layers = _layers(planes, images)
        found = [torch.zeros_like(x) if wants_gradient(x) else None for x in layers]
        with torch.no_grad():
            alphas = to_spectrum(layers.alphas, size)
            for part in channels:
                psfs, light = planes.psfs[:, part], to_spectrum(layers.light[:, :, part], size)
                grad = gradient[images, part].to(layers.light.dtype)
                spread = to_spectrum(_blend_gradients(*_blurred(light, alphas, psfs, size), grad), size)
                if of_psfs is not None:
                    of_psfs[:, part] += _psf_gradient(spread, light, alphas, size, side).to(of_psfs.dtype)
                if found[0] is not None or found[1] is not None:
                    flipped = to_spectrum(psfs.flip((-2, -1)).to(grad.dtype), size)[:, None]
                    back = from_spectrum(spread * flipped, size, 1)
                    if found[0] is not None:
                        found[0][:, :, part] = back[:, :, 0]
                    if found[1] is not None:
                        found[1] += back[:, :, 1:].sum(3).sum_to_size(found[1].shape)
        pairs += [(x, own) for x, own in zip(layers, found, strict=True) if own is not None]
    return pairs if of_psfs is None else [*pairs, (planes.psfs, of_psfs)]


def _dtype(planes: OcclusionPlanes) -> torch.dtype:
    return widest(planes.light.device)


def _parts(planes: OcclusionPlanes, part_bytes: int) -> list[tuple[slice, list[slice]]]:
    """Return images that are worked on together, each with the channels that are: as many images as possible."""
    batch, channels, height, width = planes.light.shape
    one = len(planes.psfs) * next_fast_size(height) * next_fast_size(width) * _dtype(planes).itemsize
    images = max(1, min(batch, part_bytes // one))
    together = max(1, min(channels, part_bytes // (one * images)))
    own = [slice(first, first + together) for first in range(0, channels, together)]
    return [(slice(first, first + images), own) for first in range(0, batch, images)]


def _layers(planes: OcclusionPlanes, images: slice) -> _Layers:
    dtype, psfs = _dtype(planes), planes.psfs
    own = slice(None) if len(planes.layer_index) == 1 else images
    index, weight = planes.layer_index[own, None], planes.layer_weight
    weight = None if weight is None else weight[own, None].to(dtype)
    numbers = torch.arange(len(psfs), device=psfs.device)[:, None, None]
    alphas = [weight_of_layer(index, weight, numbers), cumulative_weight(index, weight, numbers)]
    alpha = torch.stack(alphas, 2).to(dtype)  # (B or 1, D, 2, H', W')
    if planes.inside is not None:
        alpha = alpha * planes.inside
    light = planes.light[images, None].to(dtype)
    if planes.mean is not None and planes.stray_light is not None:  # both or none
        light = torch.lerp(
            light, planes.mean[images, None, :, None, None].to(dtype), planes.stray_light[..., None, None].to(dtype)
        )
    return _Layers(alpha[:, :, :1] * light, alpha)


def _blurred(light: Tensor, alphas: Tensor, psfs: Tensor, size: tuple[int, int]) -> tuple[Tensor, Tensor, Tensor]:
    """Return blurred light, alpha and cumulative alpha, (B, D, C, H, W), of spectra."""
    spectra, side = to_spectrum(psfs.to(light.real.dtype), size), psfs.shape[-1]
    both = from_spectrum(alphas[:, :, :, None] * spectra[:, None], size, side)
    both = both.expand(len(light), -1, -1, -1, -1, -1)
    return from_spectrum(light * spectra, size, side), both[:, :, 0], both[:, :, 1]


def _laid_over(light: Tensor, alpha: Tensor, cumulative: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the image (B, C, H, W), and s, 1 - a s and s T of each layer."""
    epsilon = EPSILON if cumulative.dtype == torch.float64 else EPSILON_FLOAT32
    scale = (cumulative.clamp(min=0) + epsilon).reciprocal()
    passed = 1 - alpha * scale
    beyond = passed.flip(1).cumprod(1).flip(1)  # of this layer and all nearer ones
    shares = scale.clone()
    shares[:, :-1] *= beyond[:, 1:]
    return (light * shares).sum(1), scale, passed, shares


def _blend_gradients(light: Tensor, alpha: Tensor, cumulative: Tensor, gradient: Tensor) -> Tensor:
    """Return the gradients of light, alpha and cumulative alpha, (B, D, 3, C, H, W)."""
    _, scale, passed, shares = _laid_over(light, alpha, cumulative)
    seen = light * scale
    behind = torch.zeros_like(seen)
    for layer in range(seen.shape[1] - 1):
        torch.addcmul(seen[:, layer], passed[:, layer], behind[:, layer], out=behind[:, layer + 1])
    of_light = shares * gradient[:, None]
    of_scale = torch.addcmul(light, alpha, behind, value=-1).mul_(scale).mul_(cumulative >= 0)
    return torch.stack([of_light, -of_light * behind, -of_light * of_scale], 2)


def _psf_gradient(spread: Tensor, light: Tensor, alphas: Tensor, size: tuple[int, int], side: int) -> Tensor:
    spread = spread.conj()
    product = (spread[:, :, 0] * light).sum(0) + (spread[:, :, 1:] * alphas[:, :, :, None]).sum((0, 2))
    return from_spectrum(product, size, 1)[..., :side, :side].flip((-2, -1))
