"""The overlap backend: overlapping windows, transformed in C with the PSFs of the layers in their tiles.

It does what the tiled backend does, overlap-save for gather and overlap-add for scatter, on processors with transforms
of its own (``overlap.c``), see :mod:`kornia_tidy.kernels.build`. They take a third of the time of torch's, and labels,
products and sums are made while a window is in the processor's cache.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn.functional import pad

from kornia_tidy.kernels.build import REALS, compiled
from kornia_tidy.kernels.overlap_ops import SOURCE, gather_overlap, overlap_psf_gradient, scatter_overlap
from kornia_tidy.render.backend import GradientPairs, gradient_pairs, wants_gradient
from kornia_tidy.render.backends.allocator import keep_memory
from kornia_tidy.render.backends.tile_plan import OVERLAPS, cheapest_grid, choose_grid, least_work
from kornia_tidy.render.cost_model import Work
from kornia_tidy.render.cost_profile import EPYC
from kornia_tidy.render.scene import LayeredScene


class OverlapBackend:
    """Convolution of overlapping windows by transforms in C. See :class:`kornia_tidy.render.backend.Backend`."""

    name = "overlap"

    def refusal(self, scene: LayeredScene) -> str | None:
        """Return why a scene cannot be rendered by overlapping windows, or None if it can."""
        if scene.compositing == "occlusion":
            return "overlapping windows gather and scatter light, and hide none"
        return refusal(scene.labels.layer_index.device, scene.image.dtype)

    def work(self, scene: LayeredScene) -> Work:
        """Return the work with the best windows for the scene."""
        work, scene.grids[OVERLAPS] = cheapest_grid(scene.labels, len(scene.psfs), scene.psfs.shape[-1], OVERLAPS)
        return replace(work, channels=scene.image.shape[1], itemsize=scene.image.element_size())

    def bounds(self, scene: LayeredScene) -> Iterator[Work]:
        """Yield the work for a scene with one layer in each window."""
        shape, blended = tuple(scene.labels.layer_index.shape), 1 if scene.layer_weight is None else 2
        work = least_work(shape, scene.psfs.shape[-1], blended, OVERLAPS, EPYC)
        yield replace(work, channels=scene.image.shape[1], itemsize=scene.image.element_size())

    def render(self, scene: LayeredScene) -> Tensor:
        """Return the rendered light."""
        keep_memory()
        labels, size, lost = scene.labels, window_size(scene), scene.psfs.shape[-1] - 1
        given = scene.psfs, labels.layer_index, labels.layer_weight, size
        if scene.compositing == "gather":
            return gather_overlap(scene.plane, *given)
        light = scene.plane
        return scatter_overlap(light, *given)[..., lost : light.shape[-2], lost : light.shape[-1]]

    def gradients(self, scene: LayeredScene, gradient: Tensor) -> GradientPairs:
        """Return the gradients of the padded planes, of the PSFs and of the layer weight."""
        keep_memory()
        tensors, labels = (scene.plane, scene.psfs, scene.batch_weight), scene.labels
        plane, psfs, size = tensors[0].detach(), scene.psfs.detach(), window_size(scene)
        index, weight = labels.layer_index, labels.layer_weight
        of_plane = of_psfs = of_weight = None
        # Labels of depth belong to the gradient's pixels for gather, and to those of the light for scatter.
        scatters, lost = scene.compositing == "scatter", psfs.shape[-1] - 1
        window, pixels = (pad(gradient, (lost,) * 4), plane) if scatters else (plane, gradient)
        if wants_gradient(tensors[0]) and scatters:
            of_plane = gather_overlap(window, psfs, index, weight, size, correlate=True)
        elif wants_gradient(tensors[0]):
            of_plane = scatter_overlap(pixels, psfs, index, weight, size, correlate=True)
        if wants_gradient(tensors[1]):
            of_psfs = overlap_psf_gradient(window, pixels, index, weight, len(psfs), size, correlate=scatters)
        if wants_gradient(tensors[2]):
            more = gather_overlap(window, psfs, index, weight, size, correlate=scatters, weight_gradient=True)
            of_weight = more.mul_(pixels).sum(1)
        return gradient_pairs(tensors, (of_plane, of_psfs, of_weight))


def window_size(scene: LayeredScene) -> int:
    """Return the side of the best windows for a scene, in samples."""
    grid = scene.grids.get(OVERLAPS) or choose_grid(scene.labels, len(scene.psfs), scene.psfs.shape[-1], OVERLAPS)
    return grid.size


def refusal(device: torch.device, dtype: torch.dtype) -> str | None:
    """Return why light on a device and of a type cannot be rendered by overlapping windows, or None if it can."""
    if device.type != "cpu":
        return f"overlapping windows are transformed on processors, and the image is on {device.type!r}"
    if dtype not in REALS:
        return f"overlapping windows are in float32 or float64, and the image in {dtype}"
    if compiled(SOURCE, dtype) is None:
        return "overlapping windows need a C compiler (see `kornia-tidy info`)"
    return None
