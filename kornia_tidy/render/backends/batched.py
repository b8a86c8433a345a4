"""The batched backend: batches of transforms of torch, on any device.

On a processor tiles are convolved with the PSFs of the layers that they hold and with no other. A kernel of an
accelerator takes some microseconds to launch, and a wait for a value many more: there all layers are convolved, of
whole planes or of tiles as large as memory allows, and no value of the scene is looked at.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import count, product

import torch
from torch import Tensor

from kornia_tidy.kernels.precision import widest
from kornia_tidy.render.backend import GradientPairs, Work, transform_operations
from kornia_tidy.render.backends.allocator import keep_memory
from kornia_tidy.render.backends.dense import dense_work
from kornia_tidy.render.backends.dense_occlusion import occlusion_planes
from kornia_tidy.render.backends.layer_batches import LayerBatches, Part
from kornia_tidy.render.backends.layer_sums import blend_gradients, present_in_tiles, seen
from kornia_tidy.render.backends.occlusion_batches import occlude_parts, part_gradients
from kornia_tidy.render.borders import transform_side
from kornia_tidy.render.scene import SAMPLE, LayeredScene

MOST_SAMPLES = 1 << 28  # of all layers of whole planes on an accelerator
PART_BYTES = 672 << 20  # that the planes of a part may take on an accelerator
_PRODUCT = 6  # operations of a complex product
_LAYERS = 6  # of a tile: beyond these planes channels are worked on one by one
# Planes of a layer at a time, for occlusion in each channel: spectra, products, light and quotients.
_PLANES, _OCCLUSION_PLANES = 3, 6


@dataclass(frozen=True)
class BatchedBackend:
    """Convolution of tiles in batches of transforms. See :class:`kornia_tidy.render.backend.Backend`.

    Args:
        step: samples that divide the windows on a processor: transforms of other sizes take up to twice as long.
        chunk_bytes: that the planes of a tile may take on a processor, near its cache (see allocator.py).
    """

    step: int = 64
    chunk_bytes: int = 15 << 20

    name = "batched"

    def refusal(self, scene: LayeredScene) -> str | None:
        """Return None: it supports every scene through PSFs that are the same everywhere."""
        return None if scene.field is None else "PSFs that vary over the picture are rendered cell by cell"

    def render(self, scene: LayeredScene) -> Tensor:
        """Return the rendered light, for occlusion in float64 where the device has it."""
        if scene.compositing == "occlusion":
            return occlude_parts(occlusion_planes(scene), self.parts(scene))
        sums = LayerBatches(scene, self.parts(scene))
        return sums.gather(scene.plane) if scene.compositing == "gather" else seen(scene, sums.scatter(scene.plane))

    def gradients(self, scene: LayeredScene, gradient: Tensor) -> GradientPairs:
        """Return the gradients of the planes, of the PSFs and of the layers' weights."""
        if scene.compositing != "occlusion":
            return blend_gradients(scene, LayerBatches(scene, self.parts(scene)), gradient)
        return part_gradients(occlusion_planes(scene), self.parts(scene), gradient)

    def work(self, scene: LayeredScene) -> Work:
        """Return the work, on a processor with the layers in every eighth row and column of the tiles."""
        every, labels, channels = len(scene.psfs), scene.labels, scene.image.shape[1]
        if _is_whole(scene):
            return dense_work(scene, every, at_once=every)
        occludes, (height, width) = scene.compositing == "occlusion", self.tile(scene)
        lost, size = scene.psfs.shape[-1] - 1, _pixels(scene)
        tiles = len(scene.image) * -(-size[0] // height) * -(-size[1] // width)
        pairs, layers, most = tiles * every, every, every
        if scene.image.device.type == "cpu":
            reach = lost if occludes else 0
            held = present_in_tiles(labels.every(SAMPLE), (height, width), every, reach, SAMPLE)
            pairs, layers, most = (int(number) for number in (held.sum(), held.any(0).sum(), held.sum(1).max()))
        image = channels * labels.layer_index.numel() * scene.image.element_size()
        sides = transform_side(height + lost), transform_side(width + lost)
        samples, transform = sides[0] * sides[1], transform_operations(*sides)
        plane = channels * self._plane_bytes(scene, sides)
        if occludes:  # in float64, where operations take twice as long
            operations = 2 * ((4 * channels + 2) * transform + 3 * channels * _PRODUCT * samples) * pairs
            memory = 2 * layers * plane + max(self._most_bytes(scene), _OCCLUSION_PLANES * plane * most)
            return Work(operations, memory + 2 * image + 32 * labels.layer_index.numel(), max(sides))
        operations = transform * (tiles + pairs + layers) + _PRODUCT * samples // 2 * pairs
        operations *= channels * scene.image.element_size() // 4
        memory = 2 * layers * plane + max(self._most_bytes(scene), _PLANES * plane * most // channels)
        return Work(operations, memory + 4 * image + 16 * labels.layer_index.numel(), max(sides))

    def tile(self, scene: LayeredScene) -> tuple[int, int]:
        """Return height and width of tiles: in windows of 2 P pixels or more, or as large as an accelerator allows.

        Larger tiles waste less on their overlap, smaller ones hold fewer layers.
        """
        side, size = scene.psfs.shape[-1], _pixels(scene)
        if _is_whole(scene):
            return size
        if scene.image.device.type == "cpu":
            windows = count(-(-2 * side // self.step) * self.step, self.step)
            most = next(window for window in windows if transform_side(window) == window) - side + 1
        else:
            planes = _OCCLUSION_PLANES * scene.image.shape[1] if scene.compositing == "occlusion" else _PLANES
            planes, most = planes * len(scene.psfs), max(size)
            while most > side and planes * self._plane_bytes(scene, (most + side, most + side)) > PART_BYTES:
                most = -(-most // 2)
        height, width = (-(-own // -(-own // most)) for own in size)  # alike, so that few sizes are transformed
        return height, width

    def parts(self, scene: LayeredScene) -> list[Part]:
        """Return the parts that a scene is rendered in."""
        batch, channels = scene.image.shape[:2]
        (height, width), size, every = self.tile(scene), _pixels(scene), len(scene.psfs)
        rows, columns = (
            [slice(first, min(first + own, whole)) for first in range(0, whole, own)]
            for own, whole in ((height, size[0]), (width, size[1]))
        )
        lost = scene.psfs.shape[-1] - 1
        one = self._plane_bytes(scene, (transform_side(height + lost), transform_side(width + lost)))
        here, occludes = scene.image.device.type == "cpu", scene.compositing == "occlusion"
        most = self._most_bytes(scene)
        layers, together, images = min(every, _LAYERS) if here else every, channels, 1
        if _is_whole(scene):
            images = max(1, most // (every * channels * one))
        elif not occludes and _PLANES * layers * channels * one > most:
            together = 1
        if here:
            keep_memory()
        found = []
        for first, y, x in product(range(0, batch, images), rows, columns):
            own, held = slice(first, first + images), None
            if here:
                held = _held(scene, own, y, x, lost if occludes else 0)
            found += [Part(own, slice(c, c + together), y, x, held) for c in range(0, channels, together)]
        return found

    def _most_bytes(self, scene: LayeredScene) -> int:
        return self.chunk_bytes if scene.image.device.type == "cpu" else PART_BYTES

    def _plane_bytes(self, scene: LayeredScene, sides: tuple[int, int]) -> int:
        dtype = widest(scene.image.device) if scene.compositing == "occlusion" else scene.image.dtype
        return sides[0] * sides[1] * dtype.itemsize


def _pixels(scene: LayeredScene) -> tuple[int, int]:
    """Return height and width of the pixels that tiles divide: those whose layers count, for occlusion the output's."""
    return scene.padded_size if scene.compositing == "scatter" else scene.output_size


def _held(scene: LayeredScene, images: slice, rows: slice, columns: slice, reach: int) -> list[int]:
    """Return the layers around the pixels of a part, ascending."""
    index, weight = scene.sorted_layers
    window = Part(images, slice(None), rows, columns, None).window(index, reach)
    held = torch.bincount(window.flatten(), minlength=len(scene.psfs)) > 0
    if weight is not None:
        held[1:] |= held[:-1].clone()
    return held.nonzero()[:, 0].tolist()


def _is_whole(scene: LayeredScene) -> bool:
    """Return whether whole planes are worked on: on an accelerator, while they are not too large for it."""
    height, width = scene.padded_size
    samples = len(scene.psfs) * scene.image.shape[0] * scene.image.shape[1] * height * width
    return scene.image.device.type != "cpu" and samples <= MOST_SAMPLES
