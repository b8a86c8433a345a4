r"""Occlusion: near layers hide far ones, each normalised by how much of its PSF falls on what it can be seen against.

A plain sum over layers is wrong at the outline of a near object: gather does not let its blur reach over what lies
behind, scatter darkens or brightens the seam. Here layers are laid over one another as panes of blurred opacity.

A pixel takes light from a layer through a quotient, and where it sees little of a layer the divisor is small: the
round-off of a transform in float32, some 1e-7, would be divided by as little as ``EPSILON``. So layers are blurred in
float64 whatever the type of the image. Sums made sample by sample need not be, see
:mod:`kornia_tidy.render.backends.direct_occlusion`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import torch
from torch import Tensor

from kornia_tidy.render.borders import from_spectrum, pad_border, to_spectrum
from kornia_tidy.render.layers import layer_weight, present_layers
from kornia_tidy.render.stray_light import normalised_share

EPSILON = 1e-6  # added to the divisor: white stays white to this, over the share of the PSF that a layer is seen by


def lay_over(layers: Iterable[tuple[Tensor, Tensor, Tensor]]) -> Tensor:
    r"""Lay blurred layers over one another.

    .. math:: I = \sum_d \frac{l_d}{E_d + \epsilon} \prod_{j > d} \left( 1 - \frac{a_j}{E_j + \epsilon} \right)

    Args:
        layers: from near to far, three planes each: l, the blurred light of the layer's pixels; a, their blurred
            weights; E, the blurred weights of these and of all that lies behind them.

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
    light, own, seen = next(planes)
    divisor = seen.clamp(min=0) + EPSILON  # round-off makes it fall below zero
    total, through = light / divisor, 1 - own / divisor
    for light, own, seen in planes:
        share = through / (seen.clamp(min=0) + EPSILON)
        total, through = total.addcmul(share, light), through.addcmul(share, own, value=-1)
    return total


def weight_behind(lower: Tensor, fraction: Tensor | None, index: int | Tensor) -> Tensor:
    """Return how much of each pixel lies in a layer or behind it: the sum of :func:`layer_weight` up to ``index``.

    Example:
        >>> weight_behind(torch.tensor([0, 1, 2]), torch.tensor([0.5, 0.25, 0.5]), 1)
        tensor([1.0000, 0.7500, 0.0000])
    """
    if fraction is None:
        return lower <= index
    return torch.where(lower == index, 1 - fraction, (lower < index).to(fraction.dtype))


def occlude_dense(
    image: Tensor, lower: Tensor, fraction: Tensor | None, psfs: Tensor, *, veil: Tensor | None, border: str
) -> Tensor:
    """Render with occlusion, the whole image for every layer: the definition. See :func:`lay_over`."""
    radius = psfs.shape[-1] // 2
    # Black beyond the border has no weight; let it lie in layers that are there anyway.
    sides = "replicate" if border == "zero" else border
    lower = pad_border(lower.to(image.dtype), radius, sides).long()[:, 0]
    fraction = None if fraction is None else pad_border(fraction, radius, sides)[:, 0]
    inside = pad_border(torch.ones_like(image[:1, 0]), radius, "zero") if border == "zero" else None
    mean = None if veil is None else image.mean((-2, -1))
    veil = None if veil is None else normalised_share(veil, psfs, image.shape[-2:], border)
    return occlude_planes(pad_border(image, radius, border), psfs, fraction, mean, veil, lower=lower, inside=inside)


def occlude_planes(
    light: Tensor,
    psfs: Tensor,
    fraction: Tensor | None,
    mean: Tensor | None,
    veil: Tensor | None,
    *,
    lower: Tensor,
    inside: Tensor | None,
) -> Tensor:
    """Render planes that hold what lies beyond the border, by transforms of the whole for every layer.

    Args:
        light: (B, C, H + P - 1, W + P - 1).
        psfs: (D, C, P, P).
        fraction: share of the next layer, (B or 1, H + P - 1, W + P - 1), or None.
        mean: (B, C) mean light of each image, where there is a veil.
        veil: (D, C) how much of it each layer takes on, or None.
        lower: index of each pixel's layer, of the fraction's shape.
        inside: (1, H + P - 1, W + P - 1) 1 on the image and 0 in the dark beyond it, or None for no dark.

    Returns:
        (B, C, H, W) float64.
    """
    light, psfs = light.double(), psfs.double()
    lower, fraction = lower[:, None], None if fraction is None else fraction[:, None].double()
    size, side = (light.shape[-2], light.shape[-1]), psfs.shape[-1]

    def blur(plane: Tensor, spectrum: Tensor) -> Tensor:
        plane = plane if inside is None else plane * inside[:, None]
        return from_spectrum(to_spectrum(plane, size) * spectrum, size, side)

    def near_to_far() -> Iterator[tuple[Tensor, Tensor, Tensor]]:
        for index in reversed(present_layers(lower, fraction, len(psfs))):
            spectrum = to_spectrum(psfs[index], size)
            own = layer_weight(lower, fraction, index).double()
            behind = weight_behind(lower, fraction, index).double()
            lit = light
            if mean is not None and veil is not None:  # both or none
                lit = torch.lerp(light, mean.double()[..., None, None], veil[index, :, None, None].double())
            yield blur(own * lit, spectrum), blur(own, spectrum), blur(behind, spectrum)

    return lay_over(near_to_far())
