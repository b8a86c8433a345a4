"""The Triton backend: direct convolution on graphics processors, for gather, scatter and occlusion.

Each pixel is multiplied by the PSFs of its own one or two layers: P x P products a pixel for each, however the layers
lie in the image, and however many there are. Nothing as large as the planes of all layers is kept in memory. The
kernels are those of :mod:`kornia_tidy.kernels.triton_kernels`. They make the gradients of gather and scatter too; those
of occlusion are made by transforms of all layers, as in :mod:`~kornia_tidy.render.backends.batched_occlusion`.

No value of gather and scatter is looked at, so that a training step can be captured in a CUDA graph. A pixel of no
layer, such as one whose depth is not a number, becomes NaN.
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from kornia_tidy.kernels import triton_ops
from kornia_tidy.render.backend import GradientPairs, gradient_pairs, wants_gradient
from kornia_tidy.render.backends.batched import PART_BYTES
from kornia_tidy.render.backends.batched_occlusion import occlusion_gradients
from kornia_tidy.render.backends.dense_occlusion import EPSILON, occlusion_planes
from kornia_tidy.render.backends.direct_occlusion import NEGATIVE
from kornia_tidy.render.cost_model import Work
from kornia_tidy.render.scene import LayeredScene
from kornia_tidy.runtime.reading import is_unread


class TritonBackend:
    """Direct convolution on graphics processors. See :class:`kornia_tidy.render.backend.Backend`."""

    name = "triton"

    def refusal(self, scene: LayeredScene) -> str | None:
        """Return why a scene cannot be convolved by kernels in Triton, or None if it can. Waits for occlusion alone."""
        why = triton_ops.objection(scene.image.device)
        if why is not None or scene.compositing != "occlusion" or is_unread():
            return why
        lowest = float(scene.psfs.detach().clamp(max=0).sum((-2, -1)).min())
        if lowest < -NEGATIVE:
            return (
                f"occlusion needs PSFs without negative values here, got one with {lowest:.1e} of its light below zero"
            )
        return None

    def work(self, scene: LayeredScene) -> Work:
        """Raise: its time is estimated for a graphics processor, by :mod:`kornia_tidy.render.accelerator_cost`."""
        raise NotImplementedError("the work of the Triton backend is not counted for processors")

    def bounds(self, scene: LayeredScene) -> Iterator[Work]:
        """Raise as :meth:`work` does."""
        raise NotImplementedError("the work of the Triton backend is not counted for processors")

    def render(self, scene: LayeredScene) -> Tensor:
        """Return the rendered light."""
        if scene.compositing == "occlusion":
            light, psfs, weight, mean, stray_light, index, inside = occlusion_planes(scene)
            flipped = psfs.flip((-2, -1))
            return triton_ops.occlude(light, flipped, index, weight, mean, stray_light, inside, EPSILON)
        flipped = scene.psfs.flip((-2, -1))
        if scene.compositing == "gather":
            return triton_ops.gather(scene.plane, flipped, *scene.sorted_layers)
        return triton_ops.scatter(scene.plane, flipped, *scene.sorted_layers, scene.output_size)

    def gradients(self, scene: LayeredScene, gradient: Tensor) -> GradientPairs:
        """Return the gradients of the plane, of the PSFs and of the layer weight."""
        if scene.compositing == "occlusion":
            return occlusion_gradients(occlusion_planes(scene), gradient, PART_BYTES)
        tensors = scene.plane, scene.psfs, scene.sorted_layers[1]
        wanted = [wants_gradient(x) for x in tensors]
        with torch.no_grad():
            made = _gather_gradients if scene.compositing == "gather" else _scatter_gradients
            return gradient_pairs(tensors, made(scene, gradient, wanted))


def _gather_gradients(scene: LayeredScene, gradient: Tensor, wanted: list[bool]) -> list[Tensor | None]:
    plane, psfs, (index, weight) = scene.plane, scene.psfs, scene.sorted_layers
    side = psfs.shape[-1]
    of_plane = of_psfs = of_weight = None
    if wanted[0]:
        size = plane.shape[-2], plane.shape[-1]
        of_plane = triton_ops.scatter(gradient, psfs, index, weight, size, offset=side - 1)
    if wanted[1]:
        of_psfs = triton_ops.correlate(plane, gradient, index, weight, len(psfs), side).flip((-2, -1))
    if wanted[2] and weight is not None:
        blurred = triton_ops.gather(plane, psfs.flip((-2, -1)), index, weight, weight_gradient=True)
        of_weight = (blurred * gradient).sum(1).sum_to_size(weight.shape)
    return [of_plane, of_psfs, of_weight]


def _scatter_gradients(scene: LayeredScene, gradient: Tensor, wanted: list[bool]) -> list[Tensor | None]:
    plane, psfs, (index, weight) = scene.plane, scene.psfs, scene.sorted_layers
    offset = psfs.shape[-1] - 1
    of_plane = of_psfs = of_weight = None
    if wanted[0]:
        of_plane = triton_ops.gather(gradient, psfs, index, weight, offset=offset)
    if wanted[1]:
        of_psfs = triton_ops.correlate(gradient, plane, index, weight, len(psfs), offset + 1, offset=offset)
    if wanted[2] and weight is not None:
        spread = triton_ops.gather(gradient, psfs, index, weight, offset=offset, weight_gradient=True)
        of_weight = (spread * plane).sum(1).sum_to_size(weight.shape)
    return [of_plane, of_psfs, of_weight]
