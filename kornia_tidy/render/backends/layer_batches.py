"""Gather and scatter in batches of transforms: all layers of a part of the scene are convolved at once.

A part is some rows and columns of some images, with the layers that it holds; overlap-save for gather, overlap-add for
scatter, each the other's transpose. On an accelerator a part is as large as memory allows and has all layers of the
bank: a kernel takes some microseconds to launch, and a wait for a value of the scene many more.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from kornia_tidy.render.borders import from_spectrum, to_spectrum, transform_side
from kornia_tidy.render.scene import LayeredScene


@dataclass(frozen=True, eq=False)
class Part:
    """A part of a scene that is worked on at once.

    Args:
        images: of the batch.
        channels: of the image.
        rows: of the pixels whose layers count, for occlusion of the output.
        columns: the same.
        layers: those that it holds, ascending; None: all.
    """

    images: slice
    channels: slice
    rows: slice
    columns: slice
    layers: list[int] | None

    def window(self, planes: Tensor, lost: int = 0) -> Tensor:
        """Return the part of planes (B or 1, ..., H, W), with as many rows and columns more as PSFs lose."""
        images = self.images if len(planes) > 1 else slice(None)
        rows, columns = (slice(own.start, own.stop + lost) for own in (self.rows, self.columns))
        return planes[images, ..., rows, columns]

    def chosen(self, by_layer: Tensor) -> Tensor:
        """Return a tensor's entries of the part's layers."""
        return by_layer if self.layers is None else by_layer[self.layers]

    def numbered(self, layer_index: Tensor) -> Tensor:
        """Return layers counted among the part's."""
        if self.layers is None:
            return layer_index
        return torch.bucketize(layer_index.contiguous(), torch.tensor(self.layers))


class LayerBatches:
    """See :class:`kornia_tidy.render.backends.layer_sums.LayerSums`.

    All parts are transformed as windows of one size, so that spectra of the PSFs are computed once.

    Args:
        scene: to be rendered.
        parts: of the scene.
    """

    def __init__(self, scene: LayeredScene, parts: list[Part]) -> None:
        self.psfs, self.side, self.parts = scene.psfs.detach(), scene.psfs.shape[-1], parts
        self.rim = 0 if scene.compositing == "scatter" and len(parts) == 1 else self.side - 1  # it would be cut
        self.index, weight = scene.sorted_layers
        self.weight = None if weight is None else weight.detach()
        self.tile = parts[0].rows.stop, parts[0].columns.stop  # none is larger than the first
        self.spectra: dict[tuple[tuple[int, int], bool], Tensor] = {}

    def gather(self, plane: Tensor, *, correlate: bool = False, weight_gradient: bool = False) -> Tensor:
        """Return the gathered light (B, C, h, w) of a plane."""
        if len(self.parts) == 1:
            return self._gathered(plane, self.parts[0], correlate, weight_gradient)
        whole = plane.new_empty(*plane.shape[:2], *self.index.shape[-2:])
        for part in self.parts:
            own = self._gathered(plane, part, correlate, weight_gradient)
            whole[part.images, part.channels, part.rows, part.columns] = own
        return whole

    def _gathered(self, plane: Tensor, part: Part, correlate: bool, weight_gradient: bool) -> Tensor:
        size = self._size(self.side - 1)
        light = to_spectrum(part.window(plane[:, part.channels], self.side - 1), size)
        blurred = from_spectrum(self._times_psfs(light[:, None], part, size, correlate), size, self.side)
        below, above, weight = self._labels(part, blurred)
        found = blurred.gather(1, below)[:, 0]
        if weight is None:
            return found
        other = blurred.gather(1, above)[:, 0]
        return other - found if weight_gradient else torch.lerp(found, other, weight[:, 0])

    def scatter(self, pixels: Tensor, *, correlate: bool = False) -> Tensor:
        """Return the light that pixels scatter."""
        if len(self.parts) == 1:
            return self._scattered(pixels, self.parts[0], correlate)
        whole = pixels.new_zeros(*pixels.shape[:2], *(side + self.rim for side in pixels.shape[-2:]))
        for part in self.parts:
            target = part.window(whole[:, part.channels], self.rim)
            target.add_(self._scattered(pixels, part, correlate)[..., : target.shape[-2], : target.shape[-1]])
        return whole

    def _scattered(self, pixels: Tensor, part: Part, correlate: bool) -> Tensor:
        size = self._size(self.rim)
        spectra = self._times_psfs(self._own(pixels, part, size), part, size, correlate)
        return from_spectrum(spectra.sum(1), size, 1)

    def psf_gradient(self, plane: Tensor, pixels: Tensor, *, correlate: bool = False) -> Tensor:
        """Return the gradient of the PSFs, (D, C, P, P)."""
        size, found = self._size(self.side - 1), None
        for part in self.parts:
            light = to_spectrum(part.window(plane[:, part.channels], self.side - 1), size)
            own = self._own(pixels, part, size).conj_physical_()
            if part.layers is None and part.channels == slice(0, pixels.shape[1]):
                product = (own * light[:, None]).sum(0)
                found = product if found is None else found + product
                continue
            if found is None:
                found = own.new_zeros(*self.psfs.shape[:2], *own.shape[-2:])
            for n, layer in enumerate(part.layers or range(len(self.psfs))):  # of one image
                found[layer, part.channels].addcmul_(own[0, n], light[0])
        assert found is not None
        total = from_spectrum(found, size, 1)[..., : self.side, : self.side]
        return total if correlate else total.flip((-2, -1))

    def _size(self, more: int) -> tuple[int, int]:
        return self.tile[0] + more, self.tile[1] + more

    def _times_psfs(self, spectra: Tensor, part: Part, size: tuple[int, int], correlate: bool) -> Tensor:
        """Return spectra (B, D' or 1, C, ...) times those of the PSFs of a part's layers."""
        if (key := (size, correlate)) not in self.spectra:
            self.spectra[key] = to_spectrum(self.psfs.flip((-2, -1)) if correlate else self.psfs, size)
        psfs = self.spectra[key][:, part.channels]
        if part.layers is None:
            return spectra * psfs
        spectra = spectra.expand(-1, len(part.layers), -1, -1, -1)
        found = spectra.new_empty(spectra.shape)
        for n, layer in enumerate(part.layers):  # without a copy of the layers' PSFs
            torch.mul(spectra[:, n], psfs[layer], out=found[:, n])
        return found

    def _labels(self, part: Part, planes: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return each pixel's layer below and above in planes (B, D', C, ...), and the weight of the one above."""
        below = part.numbered(part.window(self.index))[:, None, None]
        below = below.expand(len(planes), 1, planes.shape[2], -1, -1)
        weight = None if self.weight is None else part.window(self.weight)[:, None, None]
        return below, (below + 1).clamp_(max=planes.shape[1] - 1), weight

    def _own(self, pixels: Tensor, part: Part, size: tuple[int, int]) -> Tensor:
        """Return the spectra of the light of each layer's own pixels, (B, D', C, ...)."""
        light = part.window(pixels[:, part.channels])[:, None]
        count = len(self.psfs) if part.layers is None else len(part.layers)
        planes = light.new_zeros(len(light), count, *light.shape[2:-1], transform_side(size[1]))
        below, above, weight = self._labels(part, planes)
        own = planes[..., : light.shape[-1]]
        if weight is not None:
            moved = light * weight
            own.scatter_(1, above, moved)
            light = light - moved
        own.scatter_(1, below, light)
        return to_spectrum(planes, size)
