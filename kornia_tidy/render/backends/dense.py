"""The dense backend: the whole plane is convolved for every layer of the scene, in plain operations of torch.

It is the definition that other backends are compared with. They are differentiated by hand, once; a gradient that is
differentiated in turn is made by this backend instead.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from kornia_tidy.render.backend import GradientPairs, Work, gradient_pairs, transform_operations
from kornia_tidy.render.backends.dense_occlusion import occlude_dense, occlusion_planes
from kornia_tidy.render.borders import from_spectrum, to_spectrum
from kornia_tidy.render.layers import present_layers, weight_of_layer
from kornia_tidy.render.scene import LayeredScene

_PLANES = 7  # at a time: three spectra, the blurred layer, the pixels picked so far, twice, and a copy


class DenseBackend:
    """Convolution of the whole plane for every layer. See :class:`kornia_tidy.render.backend.Backend`."""

    name = "dense"

    def refusal(self, scene: LayeredScene) -> str | None:
        """Return None: it supports every scene."""
        return None

    def work(self, scene: LayeredScene) -> Work:
        """Return the work for the layers in every eighth row and column of the scene."""
        work = dense_work(scene, scene.sampled_layers, at_once=1)
        return work if scene.field is None else replace(work, operations=len(scene.psfs) * work.operations)

    def render(self, scene: LayeredScene) -> Tensor:
        """Return the rendered light, for occlusion in float64."""
        if scene.compositing == "occlusion":
            shares = None if scene.field is None else scene.places.of_pixels()
            return occlude_dense(*occlusion_planes(scene), shares)
        index, weight = scene.sorted_layers
        gathers = scene.compositing == "gather"
        composite, plane = gather_dense if gathers else scatter_dense, scene.plane
        if scene.field is None:
            return composite(plane, scene.psfs, weight, index)
        total = torch.zeros((), dtype=plane.dtype, device=plane.device)
        for share, psfs in zip(scene.places.of_pixels().to(plane), scene.psfs, strict=True):  # of each node
            if gathers:
                total = total + share * composite(plane, psfs, weight, index)
            else:
                total = total + composite(share * plane, psfs, weight, index)
        return total

    @torch.enable_grad()
    def gradients(self, scene: LayeredScene, gradient: Tensor) -> GradientPairs:
        """Return the gradients of the scene's own tensors: the light is rendered again."""
        given = scene.image, scene.layer_weight, scene.psfs, scene.stray_light
        tensors = [x for x in given if x is not None and x.requires_grad]
        coded = self.render(scene)
        if not coded.requires_grad:  # only stray light needs a gradient, and it is added later
            return []
        found = torch.autograd.grad(coded, tensors, gradient.to(coded), retain_graph=True, allow_unused=True)
        return gradient_pairs(tensors, found)


def gather_dense(plane: Tensor, psfs: Tensor, layer_weight: Tensor | None, layer_index: Tensor) -> Tensor:
    """Convolve a plane with each layer's PSF and blend at each pixel those of its layers: gather.

    Args:
        plane: (B, C, H + P - 1, W + P - 1) light.
        psfs: (D, C, P, P).
        layer_weight: (B or 1, H, W) weight of the next layer, or None for nearest layers.
        layer_index: (B or 1, H, W) index of each pixel's layer.

    Returns:
        (B, C, H, W).
    """
    size, side = (plane.shape[-2], plane.shape[-1]), psfs.shape[-1]
    index, weight = layer_index[:, None], None if layer_weight is None else layer_weight[:, None]
    light = to_spectrum(plane, size)
    # Of the sum a pixel has two terms: pick them, blend once. Autograd then keeps masks, not a blurred image a layer.
    below = above = torch.zeros((), dtype=plane.dtype, device=plane.device)
    for layer in present_layers(index, weight, len(psfs)):
        blurred = from_spectrum(light * to_spectrum(psfs[layer], size), size, side)
        below = torch.where(index == layer, blurred, below)
        if weight is not None:
            above = torch.where(index == layer - 1, blurred, above)
    return below if weight is None else torch.lerp(below, above, weight)


def scatter_dense(plane: Tensor, psfs: Tensor, layer_weight: Tensor | None, layer_index: Tensor) -> Tensor:
    """Convolve the light of each layer's pixels with its PSF and add up: scatter.

    Args:
        plane: (B, C, H + P - 1, W + P - 1) light.
        psfs: (D, C, P, P).
        layer_weight: (B or 1, H + P - 1, W + P - 1) weight of the next layer, or None for nearest layers.
        layer_index: (B or 1, H + P - 1, W + P - 1) index of each pixel's layer.

    Returns:
        (B, C, H, W).
    """
    size, side = (plane.shape[-2], plane.shape[-1]), psfs.shape[-1]
    index, weight = layer_index[:, None], None if layer_weight is None else layer_weight[:, None]
    light = torch.zeros((), dtype=plane.dtype, device=plane.device)
    for layer in present_layers(index, weight, len(psfs)):
        own = weight_of_layer(index, weight, layer) * plane
        light = light + to_spectrum(own, size) * to_spectrum(psfs[layer], size)
    return from_spectrum(light, size, side)


def dense_work(scene: LayeredScene, layers: int, at_once: int) -> Work:
    """Return the work of transforms of the whole plane.

    Args:
        scene: to be rendered.
        layers: that are convolved.
        at_once: layers with planes in memory at the same time.
    """
    (batch, channels), (height, width) = scene.image.shape[:2], scene.padded_size
    occludes, itemsize = scene.compositing == "occlusion", scene.image.element_size()
    samples, transform = batch * channels * height * width, transform_operations(height, width)
    memory = 2 * samples * itemsize + (4 if occludes else 2) * 8 * scene.labels.layer_index.numel()
    memory += (_PLANES + at_once - 1) * samples * (2 * 8 if occludes else itemsize)
    if not occludes:
        return Work(channels * itemsize // 4 * (batch + layers * (batch + 1)) * transform, memory)
    # For each layer the spectra of its light, two weights and its PSF, and three products back, in float64.
    return Work(2 * layers * (channels + batch * (4 * channels + 2)) * transform, memory)
