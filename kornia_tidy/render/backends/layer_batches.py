"""Gather and scatter in batches of transforms: all layers of a part of the scene are convolved at once.

A part is some rows and columns of some images, with the layers that it holds; overlap-save for gather, overlap-add for
scatter, each the other's transpose. On an accelerator a part is as large as memory allows and has all layers of the
bank: a kernel takes some microseconds to launch, and a wait for a value of the scene many more.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from kornia_tidy.render.borders import from_spectrum, to_spectrum
from kornia_tidy.render.layers import weight_of_layer
from kornia_tidy.render.scene import LayeredScene


@dataclass(frozen=True, eq=False)
class Part:
    """A part of a scene that is worked on at once.

    Args:
        images: of the batch.
        channels: of the image.
        rows: of the pixels whose layers count, for occlusion of the output.
        columns: the same.
        layers: (D',) those that it holds, ascending; None: all.
    """

    images: slice
    channels: slice
    rows: slice
    columns: slice
    layers: Tensor | None

    def window(self, planes: Tensor, lost: int = 0) -> Tensor:
        """Return the part of planes (B or 1, ..., H, W), with as many rows and columns more as PSFs lose."""
        images = self.images if len(planes) > 1 else slice(None)
        rows, columns = (slice(own.start, own.stop + lost) for own in (self.rows, self.columns))
        return planes[images, ..., rows, columns]

    def chosen(self, by_layer: Tensor) -> Tensor:
        """Return a tensor's entries of the part's layers."""
        return by_layer if self.layers is None else by_layer[self.layers]

    def numbered(self, layer_index: Tensor, layers: int) -> Tensor:
        """Return layers counted among the part's."""
        if self.layers is None:
            return layer_index
        numbers = torch.zeros(layers, dtype=torch.long)
        numbers[self.layers] = torch.arange(len(self.layers))
        return numbers[layer_index]


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
        self.tile = [
            max(own.stop - own.start for own in axis)
            for axis in zip(*((p.rows, p.columns) for p in parts), strict=True)
        ]
        self.spectra: dict[tuple[tuple[int, int], bool], Tensor] = {}

    def gather(self, plane: Tensor, *, correlate: bool = False, weight_gradient: bool = False) -> Tensor:
        """Return the gathered light (B, C, h, w) of a plane."""
        found = [self._gathered(plane, part, correlate, weight_gradient) for part in self.parts]
        if len(found) == 1:
            return found[0]
        whole = plane.new_empty(*plane.shape[:2], *self.index.shape[-2:])
        for part, own in zip(self.parts, found, strict=True):
            whole[part.images, part.channels, part.rows, part.columns] = own
        return whole

    def _gathered(self, plane: Tensor, part: Part, correlate: bool, weight_gradient: bool) -> Tensor:
        light, (index, weight) = part.window(plane[:, part.channels], self.side - 1), self._labels(part)
        size = self._size(self.side - 1)
        psfs = self._psfs(part, size, correlate)
        blurred = from_spectrum(to_spectrum(light, size)[:, None] * psfs, size, self.side)
        places = index[:, None, None].expand(len(blurred), 1, light.shape[1], -1, -1)
        below = blurred.gather(1, places)[:, 0]
        if weight is None or len(psfs) == 1:
            return below
        above = blurred.gather(1, (places + 1).clamp_(max=len(psfs) - 1))[:, 0]
        return above - below if weight_gradient else torch.lerp(below, above, weight[:, None])

    def scatter(self, pixels: Tensor, *, correlate: bool = False) -> Tensor:
        """Return the light that pixels scatter."""
        whole: Tensor | None = None
        for part in self.parts:
            light, size = part.window(pixels[:, part.channels]), self._size(self.rim)
            spectra = to_spectrum(self._own(light, part), size).mul_(self._psfs(part, size, correlate))
            spread = from_spectrum(spectra.sum(1), size, 1)
            if len(self.parts) == 1:
                return spread
            if whole is None:
                whole = pixels.new_zeros(*pixels.shape[:2], *(side + self.rim for side in pixels.shape[-2:]))
            target = part.window(whole[:, part.channels], self.rim)
            target.add_(spread[..., : target.shape[-2], : target.shape[-1]])
        assert whole is not None
        return whole

    def psf_gradient(self, plane: Tensor, pixels: Tensor, *, correlate: bool = False) -> Tensor:
        """Return the gradient of the PSFs, (D, C, P, P)."""
        size, found = self._size(self.side - 1), None
        for part in self.parts:
            light = to_spectrum(part.window(plane[:, part.channels], self.side - 1), size)
            own = to_spectrum(self._own(part.window(pixels[:, part.channels]), part), size)
            product = (own.conj() * light[:, None]).sum(0)
            if part.layers is None and part.channels == slice(0, pixels.shape[1]):
                found = product if found is None else found + product
                continue
            if found is None:
                found = product.new_zeros(*self.psfs.shape[:2], *product.shape[-2:])
            found[slice(None) if part.layers is None else part.layers, part.channels] += product
        assert found is not None
        total = from_spectrum(found, size, 1)[..., : self.side, : self.side]
        return total if correlate else total.flip((-2, -1))

    def _size(self, more: int) -> tuple[int, int]:
        return self.tile[0] + more, self.tile[1] + more

    def _psfs(self, part: Part, size: tuple[int, int], correlate: bool) -> Tensor:
        if (key := (size, correlate)) not in self.spectra:
            self.spectra[key] = to_spectrum(self.psfs.flip((-2, -1)) if correlate else self.psfs, size)
        return part.chosen(self.spectra[key])[:, part.channels]

    def _labels(self, part: Part) -> tuple[Tensor, Tensor | None]:
        index = part.numbered(part.window(self.index), len(self.psfs))
        return index, None if self.weight is None else part.window(self.weight)

    def _own(self, light: Tensor, part: Part) -> Tensor:
        """Return the light of each layer's own pixels, (B, D, C, h, w)."""
        index, weight = self._labels(part)
        count = len(self.psfs) if part.layers is None else len(part.layers)
        layers = torch.arange(count, device=index.device)[:, None, None]
        own = weight_of_layer(index[:, None], None if weight is None else weight[:, None], layers)
        return own.to(light.dtype)[:, :, None] * light[:, None]
