"""The batched backend: all layers of many images are convolved in one batch of transforms, for accelerators.

It makes the sums of the dense backend. A kernel of an accelerator takes some microseconds to launch, and a wait for a
value many more, so all layers of the bank are convolved, and no value of the scene is looked at. Gradients are made by
hand, of spectra that are computed again.
"""

from __future__ import annotations

import torch
from torch import Tensor

from kornia_tidy.render.backend import GradientPairs, Work
from kornia_tidy.render.backends.batched_occlusion import occlude_batched, occlusion_gradients
from kornia_tidy.render.backends.dense import dense_work
from kornia_tidy.render.backends.dense_occlusion import occlusion_planes
from kornia_tidy.render.backends.layer_sums import blend_gradients, seen
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
        sums = _Sums(scene)
        if scene.compositing == "gather":
            return sums.gather(scene.plane)
        return seen(scene, sums.scatter(scene.plane))

    def gradients(self, scene: LayeredScene, gradient: Tensor) -> GradientPairs:
        """Return the gradients of the planes, of the PSFs and of the layers' weights."""
        if scene.compositing == "occlusion":
            return occlusion_gradients(occlusion_planes(scene), gradient, PART_BYTES)
        return blend_gradients(scene, _Sums(scene), gradient)


class _Sums:
    """See :class:`kornia_tidy.render.backends.layer_sums.LayerSums`."""

    def __init__(self, scene: LayeredScene) -> None:
        self.psfs, self.side, self.scatters = scene.psfs.detach(), scene.psfs.shape[-1], scene.compositing == "scatter"
        self.index, weight = scene.sorted_layers
        self.weight = None if weight is None else weight.detach()

    def gather(self, plane: Tensor, *, correlate: bool = False, weight_gradient: bool = False) -> Tensor:
        size, found = (plane.shape[-2], plane.shape[-1]), []
        psfs = to_spectrum(self.psfs.flip((-2, -1)) if correlate else self.psfs, size)
        for part in self._parts(plane, size):
            blurred = from_spectrum(to_spectrum(plane[part], size)[:, None] * psfs, size, self.side)
            index, weight = self._labels(part)
            places = index[:, None, None].expand(len(blurred), 1, plane.shape[1], -1, -1)
            below = blurred.gather(1, places)[:, 0]
            if weight is not None and len(psfs) > 1:
                above = blurred.gather(1, (places + 1).clamp_(max=len(psfs) - 1))[:, 0]
                below = above - below if weight_gradient else torch.lerp(below, above, weight[:, None])
            found.append(below)
        return found[0] if len(found) == 1 else torch.cat(found)

    def scatter(self, pixels: Tensor, *, correlate: bool = False) -> Tensor:
        rim, found = 0 if self.scatters else self.side - 1, []  # of a capture it would be cut
        size = pixels.shape[-2] + rim, pixels.shape[-1] + rim
        psfs = to_spectrum(self.psfs.flip((-2, -1)) if correlate else self.psfs, size)
        for part in self._parts(pixels, size):
            spectra = to_spectrum(self._own(pixels, part), size) * psfs
            found.append(from_spectrum(spectra.sum(1), size, 1))
        return found[0] if len(found) == 1 else torch.cat(found)

    def psf_gradient(self, plane: Tensor, pixels: Tensor, *, correlate: bool = False) -> Tensor:
        size, found = (plane.shape[-2], plane.shape[-1]), []
        for part in self._parts(plane, size):
            own, light = to_spectrum(self._own(pixels, part), size), to_spectrum(plane[part], size)[:, None]
            found.append((own.conj() * light).sum(0))
        psfs = from_spectrum(sum(found[1:], found[0]), size, 1)[..., : self.side, : self.side]
        return psfs if correlate else psfs.flip((-2, -1))

    def _labels(self, part: slice) -> tuple[Tensor, Tensor | None]:
        own = slice(None) if len(self.index) == 1 else part
        return self.index[own], None if self.weight is None else self.weight[own]

    def _own(self, pixels: Tensor, part: slice) -> Tensor:
        """Return the light of each layer's own pixels, (B, D, C, h, w)."""
        index, weight = self._labels(part)
        layers = torch.arange(len(self.psfs), device=index.device)[:, None, None]
        own = weight_of_layer(index[:, None], None if weight is None else weight[:, None], layers)
        return own.to(pixels.dtype)[:, :, None] * pixels[part, None]

    def _parts(self, plane: Tensor, size: tuple[int, int]) -> list[slice]:
        """Return the images that are worked on together, in as few parts as memory allows."""
        one = plane.shape[1] * len(self.psfs) * next_fast_size(size[0]) * next_fast_size(size[1]) * plane.element_size()
        together = max(1, PART_BYTES // one)
        return [slice(first, first + together) for first in range(0, len(plane), together)]
