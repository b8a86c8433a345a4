"""Gather and scatter of whole planes: all layers of many images are convolved in one batch of transforms.

For accelerators: a kernel takes some microseconds to launch, and a wait for a value many more, so all layers of the
bank are convolved, and no value of the scene is looked at.
"""

from __future__ import annotations

import torch
from torch import Tensor

from kornia_tidy.render.borders import from_spectrum, next_fast_size, to_spectrum
from kornia_tidy.render.layers import weight_of_layer
from kornia_tidy.render.scene import LayeredScene


class WholeSums:
    """See :class:`kornia_tidy.render.backends.layer_sums.LayerSums`.

    Args:
        scene: to be rendered.
        part_bytes: that the planes of all layers of the images worked on together may take.
    """

    def __init__(self, scene: LayeredScene, part_bytes: int) -> None:
        self.part_bytes = part_bytes
        self.psfs, self.side, self.scatters = scene.psfs.detach(), scene.psfs.shape[-1], scene.compositing == "scatter"
        self.index, weight = scene.sorted_layers
        self.weight = None if weight is None else weight.detach()

    def gather(self, plane: Tensor, *, correlate: bool = False, weight_gradient: bool = False) -> Tensor:
        """Return the gathered light (B, C, h, w) of a plane."""
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
        """Return the light that pixels scatter."""
        rim, found = 0 if self.scatters else self.side - 1, []  # of a capture it would be cut
        size = pixels.shape[-2] + rim, pixels.shape[-1] + rim
        psfs = to_spectrum(self.psfs.flip((-2, -1)) if correlate else self.psfs, size)
        for part in self._parts(pixels, size):
            spectra = to_spectrum(self._own(pixels, part), size) * psfs
            found.append(from_spectrum(spectra.sum(1), size, 1))
        return found[0] if len(found) == 1 else torch.cat(found)

    def psf_gradient(self, plane: Tensor, pixels: Tensor, *, correlate: bool = False) -> Tensor:
        """Return the gradient of the PSFs, (D, C, P, P)."""
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
        together = max(1, self.part_bytes // one)
        return [slice(first, first + together) for first in range(0, len(plane), together)]
