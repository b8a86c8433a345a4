"""The batched backend: all layers of many images are convolved in one batch of transforms, for accelerators.

It makes the sums of the dense backend. A kernel of an accelerator takes some microseconds to launch, and a wait for a
value many more, so all layers of the bank are convolved, and no value of the scene is looked at. Gradients are made by
hand, of spectra that are computed again.
"""

from __future__ import annotations

import torch
from torch import Tensor

from kornia_tidy.render.backend import GradientPairs, Work, gradient_pairs, wants_gradient
from kornia_tidy.render.backends.batched_occlusion import occlude_batched, occlusion_gradients
from kornia_tidy.render.backends.dense import dense_work
from kornia_tidy.render.backends.dense_occlusion import occlusion_planes
from kornia_tidy.render.borders import from_spectrum, next_fast_size, to_spectrum
from kornia_tidy.render.layers import weight_of_layer
from kornia_tidy.render.scene import LayeredScene

PART_BYTES = 672 << 20  # that the planes of all layers of the images worked on together may take


class BatchedBackend:
    """Convolution of all layers in one batch. See :class:`kornia_tidy.render.backend.Backend`."""

    name = "batched"

    def refusal(self, scene: LayeredScene) -> None:
        """Return None: it supports every scene."""

    def work(self, scene: LayeredScene) -> Work:
        """Return the work for all layers of the bank."""
        return dense_work(scene, len(scene.psfs), at_once=len(scene.psfs))

    def render(self, scene: LayeredScene) -> Tensor:
        """Return the rendered light, for occlusion in float64 where the device has it."""
        if scene.compositing == "occlusion":
            return occlude_batched(occlusion_planes(scene), PART_BYTES)
        composite = _gather if scene.compositing == "gather" else _scatter
        index, weight = scene.sorted_layers
        plane, psfs, batch = scene.plane, scene.psfs, len(scene.image)
        own = index[:, None].expand(batch, -1, -1, -1)
        weight = None if weight is None else weight[:, None].expand(batch, -1, -1, -1)
        parts = _parts(plane, len(psfs))
        if len(parts) == 1:
            return composite(plane, psfs, own, weight)
        found = [composite(plane[p], psfs, own[p], None if weight is None else weight[p]) for p in parts]
        return torch.cat(found)

    def gradients(self, scene: LayeredScene, gradient: Tensor) -> GradientPairs:
        """Return the gradients of the planes, of the PSFs and of the layers' weights."""
        if scene.compositing == "occlusion":
            return occlusion_gradients(occlusion_planes(scene), gradient, PART_BYTES)
        plane, psfs = scene.plane, scene.psfs
        weights = weights_of_layers(*scene.sorted_layers, len(psfs), plane.dtype)  # (B or 1, D, 1, h, w)
        if scene.compositing == "gather":
            return _gather_gradients(plane, psfs, weights, gradient)
        return _scatter_gradients(plane, psfs, weights, gradient)


def weights_of_layers(index: Tensor, weight: Tensor | None, count: int, dtype: torch.dtype) -> Tensor:
    """Return the weights of all layers at every pixel, (B or 1, D, 1, h, w), from (B or 1, h, w) layers."""
    layers = torch.arange(count, device=index.device)[:, None, None]
    own = weight_of_layer(index[:, None], None if weight is None else weight[:, None], layers)
    return own.to(dtype)[:, :, None]


def _parts(plane: Tensor, layers: int) -> list[slice]:
    """Return the images that are worked on together, in as few parts as memory allows."""
    batch, channels, height, width = plane.shape
    one = channels * layers * next_fast_size(height) * next_fast_size(width) * plane.element_size()
    together = max(1, PART_BYTES // one)
    return [slice(first, first + together) for first in range(0, batch, together)]


def _gather(plane: Tensor, psfs: Tensor, index: Tensor, weight: Tensor | None) -> Tensor:
    """(B, C, h, w) of plane (B, C, H', W'), psfs (D, C, P, P), index and weight (B, 1, h, w)."""
    size, side = (plane.shape[-2], plane.shape[-1]), psfs.shape[-1]
    spectra = to_spectrum(plane, size)[:, None] * to_spectrum(psfs, size)
    blurred = from_spectrum(spectra, size, side)
    places = index[:, :, None].expand(-1, -1, plane.shape[1], -1, -1)
    below = blurred.gather(1, places)[:, 0]
    if weight is None or len(psfs) == 1:
        return below
    return torch.lerp(below, blurred.gather(1, (places + 1).clamp_(max=len(psfs) - 1))[:, 0], weight)


def _scatter(plane: Tensor, psfs: Tensor, index: Tensor, weight: Tensor | None) -> Tensor:
    """(B, C, h, w) of plane (B, C, H', W'), psfs (D, C, P, P), index and weight (B, 1, H', W')."""
    size, side = (plane.shape[-2], plane.shape[-1]), psfs.shape[-1]
    own = weights_of_layers(index[:, 0], None if weight is None else weight[:, 0], len(psfs), plane.dtype)
    spectra = to_spectrum(own * plane[:, None], size) * to_spectrum(psfs, size)
    return from_spectrum(spectra.sum(1), size, side)


def _gather_gradients(plane: Tensor, psfs: Tensor, weights: Tensor, gradient: Tensor) -> GradientPairs:
    given = plane, psfs, weights
    of_plane, of_psfs, of_weights = (torch.zeros_like(x) if wants_gradient(x) else None for x in given)
    size, side = (plane.shape[-2], plane.shape[-1]), psfs.shape[-1]
    with torch.no_grad():
        for part in _parts(plane, len(psfs)):
            grad, own = gradient[part, None], weights if len(weights) == 1 else weights[part]
            if of_plane is not None or of_psfs is not None:
                spread = to_spectrum(own * grad, size)
            if of_psfs is not None:
                light = to_spectrum(plane[part], size)[:, None]
                of_psfs += psf_gradient((spread.conj() * light).sum(0), size, side)
            if of_plane is not None:
                flipped = to_spectrum(psfs.flip((-2, -1)), size)
                of_plane[part] = from_spectrum((spread * flipped).sum(1), size, 1)
            if of_weights is not None:
                spectra = to_spectrum(plane[part], size)[:, None] * to_spectrum(psfs, size)
                found = (from_spectrum(spectra, size, side) * grad).sum(2, keepdim=True)
                _add(of_weights, found, part)
    return gradient_pairs(given, (of_plane, of_psfs, of_weights))


def _scatter_gradients(plane: Tensor, psfs: Tensor, weights: Tensor, gradient: Tensor) -> GradientPairs:
    given = plane, psfs, weights
    of_plane, of_psfs, of_weights = (torch.zeros_like(x) if wants_gradient(x) else None for x in given)
    size, side = (plane.shape[-2], plane.shape[-1]), psfs.shape[-1]
    with torch.no_grad():
        for part in _parts(plane, len(psfs)):
            grad, own = to_spectrum(gradient[part], size)[:, None], weights if len(weights) == 1 else weights[part]
            if of_psfs is not None:
                light = to_spectrum(own * plane[part, None], size)
                of_psfs += psf_gradient((grad.conj() * light).sum(0), size, side)
            if of_plane is not None or of_weights is not None:
                blurred = from_spectrum(grad * to_spectrum(psfs.flip((-2, -1)), size), size, 1)
                if of_plane is not None:
                    of_plane[part] = (own * blurred).sum(1)
                if of_weights is not None:
                    _add(of_weights, (blurred * plane[part, None]).sum(2, keepdim=True), part)
    return gradient_pairs(given, (of_plane, of_psfs, of_weights))


def psf_gradient(product: Tensor, size: tuple[int, int], side: int) -> Tensor:
    """Return the gradient of PSFs from the spectrum of light correlated with the gradient of the blurred light.

    Args:
        product: conjugate spectrum of the gradient times that of the light.
        size: of the padded plane.
        side: of the PSFs.
    """
    return from_spectrum(product, size, 1)[..., :side, :side].flip((-2, -1))


def _add(total: Tensor, found: Tensor, part: slice) -> None:
    """Add the gradient of a part's weights; a batch may share them."""
    if len(total) == 1:
        total += found.sum(0, keepdim=True)
    else:
        total[part] += found
