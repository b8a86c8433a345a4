r"""Occlusion in batches of transforms: all layers of a part of the scene at once.

The planes of :mod:`kornia_tidy.render.backends.dense_occlusion`, laid over one another by a product over the layers
instead of one after the other:

.. math:: I = \sum_d l_d s_d T_d, \qquad s_d = \frac{1}{\max(E_d, 0) + \epsilon}, \qquad
    T_d = \prod_{j > d} (1 - a_j s_j)

Its gradients need the light that shines through from behind each layer, :math:`R_{d+1} = l_d s_d + (1 - a_d s_d) R_d`:
:math:`\partial I / \partial l_d = s_d T_d`, :math:`\partial I / \partial a_d = -s_d T_d R_d` and
:math:`\partial I / \partial E_d = -s_d^2 T_d (l_d - a_d R_d)`.

On a device without float64 transforms are made in float32, and :math:`\epsilon` is 1e-3, as in Ikoma et al. 2021: the
round-off of a transform, some 1e-7, is divided by no less.
"""

from __future__ import annotations

from typing import Any, cast

import torch
from torch import Tensor

from kornia_tidy.kernels.precision import widest
from kornia_tidy.render.backend import GradientPairs, gradient_pairs
from kornia_tidy.render.backends.dense_occlusion import EPSILON, OcclusionPlanes, cumulative_weight
from kornia_tidy.render.backends.layer_batches import Part
from kornia_tidy.render.borders import from_spectrum, to_spectrum
from kornia_tidy.render.layers import weight_of_layer

EPSILON_FLOAT32 = 1e-3  # as in the source: on devices without float64 round-off is some 1e-7 of the light


def occlude_parts(planes: OcclusionPlanes, parts: list[Part]) -> Tensor:
    """Render parts with occlusion; the definition is :func:`~.dense_occlusion.occlude_dense`.

    Returns:
        (B, C, H, W) in float64, or in float32 where the device has nothing wider.
    """
    if len(parts) == 1:
        return _occluded(planes, parts[0])
    lost, light = planes.psfs.shape[-1] - 1, planes.light
    height, width = (side - lost for side in light.shape[-2:])
    coded = light.new_empty(*light.shape[:2], height, width, dtype=widest(light.device))
    for part in parts:
        coded[part.images, :, part.rows, part.columns] = _occluded(planes, part)
    return coded


def part_gradients(planes: OcclusionPlanes, parts: list[Part], gradient: Tensor) -> GradientPairs:
    """Return the gradients of the planes, part by part.

    Args:
        planes: of the scene.
        parts: of the output.
        gradient: (B, C, H, W) of the rendered light.
    """
    own: list[Any] = [None if x is None else x.detach().requires_grad_(x.requires_grad) for x in planes]
    for part in parts:
        with torch.enable_grad():
            coded = _occluded(OcclusionPlanes(*own), part)
        coded.backward(part.window(gradient).to(coded))
    return gradient_pairs(planes, [None if x is None else x.grad for x in own])


def _occluded(planes: OcclusionPlanes, part: Part) -> Tensor:
    """Render a part with the layers in it."""
    psfs, stray, dtype = part.chosen(planes.psfs), planes.stray_light, widest(planes.light.device)
    side = psfs.shape[-1]

    def own(plane: Tensor) -> Tensor:
        return part.window(plane, side - 1)

    index, weight = part.numbered(own(planes.layer_index))[:, None], planes.layer_weight
    weight = None if weight is None else own(weight)[:, None].to(dtype)
    numbers = torch.arange(len(psfs), device=psfs.device)[:, None, None]
    alphas = [weight_of_layer(index, weight, numbers), cumulative_weight(index, weight, numbers)]
    alpha = torch.stack(alphas, 2).to(dtype)  # (B or 1, D, 2, H', W')
    if planes.inside is not None:
        alpha = alpha * own(planes.inside)
    light = own(planes.light)[:, None].to(dtype)
    size = light.shape[-2], light.shape[-1]
    if planes.mean is not None and stray is not None:  # both or none
        mean = planes.mean[part.images, None, :, None, None].to(dtype)
        light = torch.lerp(light, mean, part.chosen(stray)[..., None, None].to(dtype))
    spectra = to_spectrum(psfs.to(dtype), size)
    seen = from_spectrum(to_spectrum(alpha[:, :, :1] * light, size) * spectra, size, side)
    both = from_spectrum(to_spectrum(alpha, size)[:, :, :, None] * spectra[:, None], size, side)
    return cast("Tensor", _LayOver.apply(seen, both.expand(len(seen), -1, -1, -1, -1, -1)))


class _LayOver(torch.autograd.Function):
    """The layers over one another: blurred light (B, D, C, h, w), alpha and cumulative alpha (B, D, 2, C, h, w)."""

    @staticmethod
    def forward(ctx: Any, light: Tensor, alphas: Tensor) -> Tensor:
        alpha, cumulative = alphas.unbind(2)
        epsilon = EPSILON if cumulative.dtype == torch.float64 else EPSILON_FLOAT32
        scale = (cumulative.clamp(min=0) + epsilon).reciprocal()
        passed = 1 - alpha * scale
        beyond = passed.flip(1).cumprod(1).flip(1)  # of this layer and all nearer ones
        shares = scale.clone()
        shares[:, :-1].mul_(beyond[:, 1:])
        ctx.save_for_backward(light, alpha, cumulative, scale, passed, shares)
        return (light * shares).sum(1)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, ...]:
        light, alpha, cumulative, scale, passed, shares = ctx.saved_tensors
        seen, of_alphas = light * scale, light.new_zeros(*light.shape[:2], 2, *light.shape[2:])
        behind, of_scale = of_alphas.unbind(2)
        for layer in range(seen.shape[1] - 1):
            torch.addcmul(seen[:, layer], passed[:, layer], behind[:, layer], out=behind[:, layer + 1])
        torch.addcmul(light, alpha, behind, value=-1, out=of_scale).mul_(scale).mul_(cumulative >= 0)
        of_light = shares * gradient[:, None]
        of_alphas.mul_(of_light.neg()[:, :, None])
        return of_light, of_alphas
