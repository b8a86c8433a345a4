r"""Occlusion in plain operations of torch: blurred, normalised layers are composited from near to far.

A plain sum over layers is wrong at the outline of a near object: gather does not let its blur reach over the
background, scatter darkens or brightens the seam. Here layers of blurred opacity are laid over one another.

A pixel takes light from a layer through a quotient, and where it sees little of a layer the divisor is small: the
round-off of a transform in float32, some 1e-7, would be divided by as little as ``EPSILON``. So layers are blurred in
float64 whatever the type of the image. Direct sums need not be, see
:mod:`kornia_tidy.render.backends.compiled`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from kornia_tidy.render.borders import from_spectrum, pad_border, to_spectrum
from kornia_tidy.render.layers import present_layers, weight_of_layer
from kornia_tidy.render.scene import LayeredScene
from kornia_tidy.render.stray_light import normalised_share

EPSILON = 1e-6  # added to the divisor: white stays white to this, over the share of the PSF that a layer is seen by
_NODES = 4  # of a field at a time: planes are blurred by the PSF of each


def lay_over(layers: Iterable[tuple[Tensor, Tensor, Tensor]]) -> Tensor:
    r"""Composite blurred layers from near to far.

    .. math:: I = \sum_d \frac{l_d}{E_d + \epsilon} \prod_{j > d} \left( 1 - \frac{a_j}{E_j + \epsilon} \right)

    Args:
        layers: from near to far, three planes each: l, the blurred light of the layer's pixels; a, the layer's alpha,
            their blurred weights; E, the cumulative alpha, the blurred weights of these and of all layers behind.

    Returns:
        The image.

    Source: Ikoma et al., Depth from Defocus with Learned Optics, ICCP 2021, the occlusion-aware image formation.

    Example:
        >>> near = (torch.tensor(0.2), torch.tensor(0.25), torch.tensor(1.0))  # a quarter of the PSF sees it
        >>> far = (torch.tensor(0.05), torch.tensor(0.5), torch.tensor(0.5))
        >>> round(float(lay_over([near, far])), 4)  # 0.2 + (1 - 0.25) * 0.05 / 0.5
        0.275
    """
    planes = iter(layers)
    light, alpha, cumulative_alpha = next(planes)
    normaliser = cumulative_alpha.clamp(min=0) + EPSILON  # round-off makes it fall below zero
    total, transmitted = light / normaliser, 1 - alpha / normaliser
    for light, alpha, cumulative_alpha in planes:
        scale = transmitted / (cumulative_alpha.clamp(min=0) + EPSILON)
        total, transmitted = total.addcmul(scale, light), transmitted.addcmul(scale, alpha, value=-1)
    return total


def cumulative_weight(layer_index: Tensor, layer_weight: Tensor | None, layer: int | Tensor) -> Tensor:
    """Return each pixel's weight in a layer and all layers behind it: the sum of the layers' weights up to ``layer``.

    Example:
        >>> cumulative_weight(torch.tensor([0, 1, 2]), torch.tensor([0.5, 0.25, 0.5]), 1)
        tensor([1.0000, 0.7500, 0.0000])
    """
    if layer_weight is None:
        return layer_index <= layer
    return torch.where(layer_index == layer, 1 - layer_weight, (layer_index < layer).to(layer_weight.dtype))


class OcclusionPlanes(NamedTuple):
    """The planes of a scene with occlusion, its border included.

    Args:
        light: (B, C, H + P - 1, W + P - 1).
        psfs: (D, C, P, P).
        layer_weight: (B or 1, H + P - 1, W + P - 1) weight of the next layer, or None.
        mean: (B, C) mean light of each image, where there is stray light.
        stray_light: (D, C) fraction of the mean light that each layer takes on, or None.
        layer_index: (B or 1, H + P - 1, W + P - 1) int64.
        inside: (1, H + P - 1, W + P - 1) 1 on the image and 0 in the dark beyond it, or None for no dark.
    """

    light: Tensor
    psfs: Tensor
    layer_weight: Tensor | None
    mean: Tensor | None
    stray_light: Tensor | None
    layer_index: Tensor
    inside: Tensor | None


def occlusion_planes(scene: LayeredScene) -> OcclusionPlanes:
    """Return the planes that a scene with occlusion is rendered from."""
    image, stray_light, inside = scene.image, scene.stray_light, None
    if scene.border == "zero":
        inside = pad_border(torch.ones_like(image[:1, 0]), scene.psfs.shape[-1] // 2, "zero")
    mean = None if stray_light is None else image.mean((-2, -1))
    if stray_light is not None:
        stray_light = normalised_share(stray_light, scene.psfs, image.shape[-2:], scene.border)
    index, weight = scene.sorted_layers
    return OcclusionPlanes(scene.plane, scene.psfs, weight, mean, stray_light, index, inside)


def occlude_dense(
    light: Tensor,
    psfs: Tensor,
    layer_weight: Tensor | None,
    mean: Tensor | None,
    stray_light: Tensor | None,
    layer_index: Tensor,
    inside: Tensor | None,
    shares: Tensor | None = None,
) -> Tensor:
    """Render with occlusion by transforms of the whole plane for every layer, see :func:`lay_over`.

    With PSFs over the field the planes that are divided are those of the PSF of the pixel that sees, and each layer
    keeps that PSF's light.

    Args:
        light: image with its border, see :class:`OcclusionPlanes` for all arguments.
        psfs: of the layers.
        layer_weight: weight of the next layer, or None.
        mean: mean light of each image, or None.
        stray_light: fraction of the mean that each layer takes on, or None.
        layer_index: of each pixel.
        inside: 1 on the image and 0 in the dark beyond it, or None.
        shares: (F, H, W) weight of each node of a field, with PSFs (F, D, C, P, P), at each pixel.

    Returns:
        (B, C, H, W) float64.
    """
    light, psfs, index = light.double(), psfs.double(), layer_index[:, None]
    weight = None if layer_weight is None else layer_weight[:, None].double()
    nodes = psfs[None] if shares is None else psfs
    size, side = (light.shape[-2], light.shape[-1]), psfs.shape[-1]

    def blur(plane: Tensor, spectra: Tensor) -> Tensor:
        own = to_spectrum(plane if inside is None else plane * inside[:, None], size)
        if shares is None:
            return from_spectrum(own * spectra[0], size, side)
        total = torch.zeros((), dtype=light.dtype, device=light.device)
        for some, share in zip(spectra.split(_NODES), shares.to(light).split(_NODES), strict=True):
            blurred = from_spectrum(own * some[:, None], size, side)
            total = total + (share[:, None, None] * blurred).sum(0)
        return total

    def near_to_far() -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        for layer in reversed(present_layers(index, weight, nodes.shape[1])):
            spectra = to_spectrum(nodes[:, layer], size)
            own = weight_of_layer(index, weight, layer).double()
            cumulative = cumulative_weight(index, weight, layer).double()
            lit = light
            if mean is not None and stray_light is not None:  # both or none
                lit = torch.lerp(light, mean.double()[..., None, None], stray_light[layer, :, None, None].double())
            seen = blur(own * lit, spectra)
            if shares is not None:
                seen = seen * torch.einsum("fhw,fc->chw", shares.to(light), nodes[:, layer].sum((-2, -1)))
            yield seen, blur(own, spectra), blur(cumulative, spectra)

    return lay_over(near_to_far())
