r"""Stray light in a dark surround: how much of the light outside the PSF's window still falls into the image.

Outside its window a PSF is not known; only the share v of the light out there is, and the renderer spreads it evenly.
Where the border continues the image, as much of it comes in from beyond as leaves. With the border ``zero`` nothing
lies beyond: light comes from pixels of the image only, and light that lands outside is lost. How far it flies then
matters. Behind an aperture with sharp edges, those of the mask's pixels included, the light falls as the inverse cube
of the distance (Airy's pattern does on average), so that the light beyond a ring of pixels falls as the inverse of its
radius.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from kornia_tidy.kernels.precision import has_float64
from kornia_tidy.render.layers import blend_of_layers
from kornia_tidy.render.scene import LayeredScene

_RINGS = 128  # at most; in larger images neighbours stand together, each group's light spread evenly over its pixels


def share_within(height: int, width: int, psf_size: int, device: torch.device | None = None) -> Tensor:
    r"""Return the share of the stray light around each pixel that stays within an image on black.

    .. math:: w(y) = \sum_{x,\, k > r} t_k, \qquad t_k = \frac{1}{8k} \, \frac{r + 1/2}{(k - 1/2)(k + 1/2)}, \qquad
        k = \max(|x_1 - y_1|, |x_2 - y_2|)

    Rings k of 8k pixels, beyond the window's radius r, hold a share of the stray light in all of one.

    Args:
        height: of the image, in pixels.
        width: of the image, in pixels.
        psf_size: side of the PSF's window 2r + 1, in pixels.
        device: where to put it.

    Returns:
        (height, width) float64, or float32 on a device without it, in [0, 1): share of a pixel's stray light that lands
        in the image, equal to the share that it receives from there. Zero where the window is at least ``2 *
        max(height, width) - 1`` pixels wide.

    Source: Born and Wolf, Principles of Optics, 8.5.2: encircled energy of a circular aperture.

    Example:
        >>> share_within(1, 3, 1).round(decimals=3).tolist()  # of the first ring, 2/3 of the light, each has an eighth
        [[0.092, 0.167, 0.092]]
        >>> float(share_within(4, 4, 7).max())
        0.0
    """
    if device is not None and not has_float64(device):
        return share_within(height, width, psf_size).float().to(device)
    radius, last = psf_size // 2, max(height, width) - 1
    if last <= radius:
        return torch.zeros(height, width, dtype=torch.float64, device=device)
    ratio = (last + 0.5) / (radius + 0.5)
    edges = sorted({round((radius + 0.5) * ratio ** (j / _RINGS) - 0.5) for j in range(_RINGS + 1)})
    ring = torch.tensor(edges, dtype=torch.float64, device=device)
    beyond = (radius + 0.5) / (ring + 0.5)  # share of the stray light outside each ring
    density = -beyond.diff() / (2 * ring + 1).square().diff()
    # Squares of pixels, with the step of the density at the edge of each, add up to rings of even density.
    steps = torch.cat([-density[:1], -density.diff(), density[-1:]])
    down, across = (pixels_around(side, ring) for side in (height, width))
    return (down * steps) @ across.mT


def pixels_around(side: int, radius: Tensor) -> Tensor:
    """Return how many pixels of a line lie within a radius of each pixel, (side, K), for K radii.

    Example:
        >>> pixels_around(3, torch.tensor([1.0])).flatten().tolist()
        [2.0, 3.0, 2.0]
    """
    at = torch.arange(side, dtype=torch.float64, device=radius.device)[:, None]
    return (at + radius).clamp(max=side - 1) - (at - radius).clamp(min=0) + 1


def spread_evenly(light: Tensor, psf_size: int, border: str) -> Tensor:
    """Return the stray light on each pixel: the mean of light that has strayed, for a zero border the part that stays.

    Args:
        light: (..., H, W) light that leaves the PSFs' window, at the pixels that it comes from.
        psf_size: side of the PSF's window in pixels.
        border: continuation of the image beyond its edges, see :mod:`kornia_tidy.render.borders`.

    Returns:
        (..., 1, 1), or (..., H, W) for the border ``"zero"``.
    """
    mean = light.mean((-2, -1), keepdim=True)
    if border != "zero":
        return mean
    return mean * share_within(*light.shape[-2:], psf_size, light.device).to(light.dtype)


def stray_light_of(scene: LayeredScene) -> Tensor:
    """Return the stray light that gather or scatter adds to a scene, broadcastable to (B, C, h, w).

    Gather takes it by the layer of the pixel that it falls on, scatter by the layer of the pixel that it comes from.

    Args:
        scene: with stray light.
    """
    assert scene.stray_light is not None
    if scene.compositing == "scatter":
        strayed = blend_of_layers(scene.stray_light, scene.layer_index, scene.layer_weight) * scene.image
        return spread_evenly(strayed, scene.psfs.shape[-1], scene.border)
    index, weight = scene.sorted_layers
    taken = blend_of_layers(scene.stray_light, index[:, None], None if weight is None else weight[:, None])
    return taken * spread_evenly(scene.image, scene.psfs.shape[-1], scene.border)


def normalised_share(stray_light: Tensor, psfs: Tensor, shape: Sequence[int], border: str) -> Tensor:
    r"""Return the fraction of stray light in a pixel, where PSFs are normalised by the weight that they cover.

    .. math:: v' = \frac{v \, \overline{w}}{\overline{h * 1} + v \, \overline{w}}

    This is for occlusion, which does not see black beyond a border of zeros. With every other border it
    is v itself.

    Args:
        stray_light: v, (D, C).
        psfs: h, (D, C, P, P).
        shape: height and width of the image.
        border: continuation of the image beyond its edges.
    """
    if border != "zero":
        return stray_light
    dtype, device = stray_light.dtype, stray_light.device
    stray = stray_light * share_within(*shape, psfs.shape[-1], device).mean().to(dtype)
    held = share_in_frame(psfs, shape).to(dtype)
    return stray / (held + stray).clamp(min=torch.finfo(dtype).tiny)


def share_in_frame(psfs: Tensor, shape: Sequence[int]) -> Tensor:
    """Return how much of the light of PSFs falls into an image, averaged over the pixels that it comes from.

    Args:
        psfs: (..., P, P).
        shape: height and width of the image.

    Returns:
        (...).

    Example:
        >>> share_in_frame(torch.full((3, 3), 1 / 9), (1, 1))
        tensor(0.1111)
    """
    offset = torch.arange(psfs.shape[-1], dtype=psfs.dtype, device=psfs.device) - psfs.shape[-1] // 2
    down, across = (
        (1 - offset.abs() / side).clamp(min=0) for side in shape
    )  # fraction of pixels with a neighbour inside
    return (psfs * (down[:, None] * across)).sum((-2, -1))
