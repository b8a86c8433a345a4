"""The direct backend: convolution with SIMD vectors, sample by sample, on processors.

A block of 4 x 32 pixels (in float32) is convolved with the PSFs of its own layers and with no other: P x P products a
pixel for each. For PSFs of up to some 40 pixels that is faster than transforms, whose tiles are larger and hold more
layers. The work is done in C (``direct.c``), see :mod:`kornia_tidy.kernels.build`. The gradient with respect to the
image is made by overlapping windows (``overlap.c``): a pixel's light goes to pixels of many layers.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from kornia_tidy.kernels import gather_ops
from kornia_tidy.kernels.build import REALS, compiled
from kornia_tidy.kernels.gather_ops import SOURCE, gather_direct, gather_direct_psf_gradient
from kornia_tidy.kernels.occlusion_ops import occlusion_direct, occlusion_direct_gradients
from kornia_tidy.kernels.overlap_ops import scatter_overlap
from kornia_tidy.render.backend import GradientPairs, gradient_pairs, wants_gradient
from kornia_tidy.render.backends import direct_occlusion
from kornia_tidy.render.backends.allocator import keep_memory
from kornia_tidy.render.backends.dense_occlusion import occlusion_planes
from kornia_tidy.render.backends.tile_plan import OVERLAPS, WINDOWS, choose_grid
from kornia_tidy.render.backends.tiled_occlusion import occlusion_gradients
from kornia_tidy.render.cost_model import DirectWork, Work
from kornia_tidy.render.scene import Labels, LayeredScene

EVERY = 4  # columns of strips are counted in every fourth row of them


class DirectBackend:
    """Convolution with SIMD vectors. See :class:`kornia_tidy.render.backend.Backend`."""

    name = "direct"

    def refusal(self, scene: LayeredScene) -> str | None:
        """Return why a scene cannot be convolved directly, or None if it can."""
        if scene.compositing == "scatter":
            return "direct convolution gathers light and does not scatter it"
        if scene.compositing == "occlusion":
            return direct_occlusion.refusal(scene.output_size, scene.psfs)
        return refusal(scene.labels, scene.image.dtype)

    def work(self, scene: LayeredScene) -> Work:
        """Return the work, from the pairs of strips and layers; of occlusion from those of blocks and layers."""
        if scene.compositing == "occlusion":
            return direct_occlusion.scene_work(scene)
        strips = count_pairs(scene.labels, scene.image.dtype)
        channels, itemsize = scene.image.shape[1], scene.image.element_size()
        return DirectWork(scene.labels.layer_index.numel(), strips, scene.psfs.shape[-1], channels, itemsize)

    def bounds(self, scene: LayeredScene) -> Iterator[Work]:
        """Yield no work: to count is cheap."""
        yield DirectWork(0, 0, scene.psfs.shape[-1])

    def render(self, scene: LayeredScene) -> Tensor:
        """Return the rendered light."""
        keep_memory()
        if scene.compositing == "occlusion":
            light, psfs, weight, mean, stray_light, index, inside = occlusion_planes(scene)
            return occlusion_direct(light, psfs, index, weight, mean, stray_light, inside)
        return gather_direct(scene.plane, scene.psfs, scene.labels.layer_index, scene.labels.layer_weight)

    def gradients(self, scene: LayeredScene, gradient: Tensor) -> GradientPairs:
        """Return the gradients of PSFs and layer weight directly, that of the image by transforms."""
        keep_memory()
        labels, layers, side = scene.labels, len(scene.psfs), scene.psfs.shape[-1]
        if scene.compositing == "occlusion":
            return _occlusion_gradients(scene, gradient)
        tensors = scene.plane, scene.psfs, scene.batch_weight
        plane, psfs, index, weight = tensors[0].detach(), scene.psfs.detach(), labels.layer_index, labels.layer_weight
        of_plane = of_psfs = of_weight = None
        if wants_gradient(tensors[0]):
            size = choose_grid(labels, layers, side, OVERLAPS).size
            of_plane = scatter_overlap(gradient, psfs, index, weight, size, correlate=True)
        if wants_gradient(tensors[1]):
            of_psfs = gather_direct_psf_gradient(plane, gradient, index, weight, layers)
        if wants_gradient(tensors[2]):
            of_weight = gather_direct(plane, psfs, index, weight, weight_gradient=True).mul_(gradient).sum(1)
        return gradient_pairs(tensors, (of_plane, of_psfs, of_weight))


def _occlusion_gradients(scene: LayeredScene, gradient: Tensor) -> GradientPairs:
    """Return the gradients of PSFs and stray light directly; with those of image or depth all of them by tiles."""
    planes = occlusion_planes(scene)
    light, psfs, weight, mean, stray_light, index, inside = planes
    if any(wants_gradient(x) for x in (light, weight, mean)):
        grid = choose_grid(scene.labels, len(psfs), psfs.shape[-1], WINDOWS)
        return occlusion_gradients(planes, scene.labels, grid, WINDOWS, gradient)
    with torch.no_grad():
        found = occlusion_direct_gradients(light, psfs, index, weight, mean, stray_light, inside, gradient)
    pairs = gradient_pairs((psfs, stray_light), (*found, None)[:2])
    return [(tensor, own) for tensor, own in pairs if tensor.requires_grad]


def refusal(labels: Labels, dtype: torch.dtype) -> str | None:
    """Return why light cannot be gathered directly, or None if it can.

    Args:
        labels: the layers of the output's pixels.
        dtype: of the light.
    """
    index = labels.layer_index
    if index.device.type != "cpu":
        return f"direct convolution runs on processors, and the image is on {index.device.type!r}"
    if dtype not in REALS:
        return f"direct convolution is in float32 or float64, and the image in {dtype}"
    (height, width), smallest = index.shape[-2:], gather_ops.smallest_output(dtype)
    if height < smallest[0] or width < smallest[1]:
        least = "x".join(map(str, smallest))
        return f"direct convolution needs an output of at least {least} pixels, got {height}x{width}"
    if compiled(SOURCE, dtype) is None:
        return "direct convolution needs a C compiler (see `kornia-tidy info`)"
    return None


def can_go_directly(labels: Labels, dtype: torch.dtype) -> bool:
    """Return whether light can be gathered directly, see :func:`refusal`."""
    return refusal(labels, dtype) is None


def count_pairs(labels: Labels, dtype: torch.dtype) -> int:
    """Return the number of pairs of a strip and a layer present in it, from every fourth row of strips."""
    return EVERY * gather_ops.count_pairs(labels.layer_index, labels.layer_weight, dtype, EVERY)
