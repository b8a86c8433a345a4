"""The batched backend: batches of transforms of torch, on any device.

On a processor each block of two tiles is convolved with the PSFs of the layers that it contains and with no other. A
kernel of an accelerator takes some microseconds to launch, and a wait for a value many more: there all layers are
convolved, of whole planes or of tiles as large as memory allows, and no value of the scene is looked at.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import count

from torch import Tensor

from kornia_tidy.kernels.precision import widest
from kornia_tidy.kernels.window_sides import needed_side, next_fast_size
from kornia_tidy.render.backend import GradientPairs, Work, transform_operations
from kornia_tidy.render.backends.allocator import keep_memory
from kornia_tidy.render.backends.dense import dense_work
from kornia_tidy.render.backends.dense_occlusion import occlusion_planes
from kornia_tidy.render.backends.layer_sums import LayerSums, blend_gradients, seen
from kornia_tidy.render.backends.tile_occlusion import occlude_tiles, tile_gradients
from kornia_tidy.render.backends.tile_sums import TileSums
from kornia_tidy.render.backends.tiles import Grid, Plan, plan_pairs
from kornia_tidy.render.backends.whole_occlusion import occlude_whole, whole_gradients
from kornia_tidy.render.backends.whole_sums import WholeSums
from kornia_tidy.render.scene import SAMPLE, LayeredScene

MOST_SAMPLES = 1 << 28  # of all layers of whole planes on an accelerator
PART_BYTES = 672 << 20  # that the planes of a chunk may take on an accelerator
_STEP = 16  # samples that divide windows on processors: transforms of other sizes take up to twice as long
_PRODUCT = 6  # operations of a complex product
# Planes of a pair at a time, for occlusion in each channel: spectra, products, light and quotients.
_PLANES, _OCCLUSION_PLANES = 3, 6


@dataclass(frozen=True)
class BatchedBackend:
    """Convolution of tiles in batches of transforms. See :class:`kornia_tidy.render.backend.Backend`.

    Args:
        smallest: side of the smallest windows on a processor: calls of smaller ones take longer than their transforms.
        chunk_bytes: that the planes of a chunk may take on a processor, near its cache (see allocator.py).
    """

    smallest: int = 64
    chunk_bytes: int = 15 << 20

    name = "batched"

    def refusal(self, scene: LayeredScene) -> str | None:
        """Return None: it supports every scene through PSFs that are the same everywhere."""
        return None if scene.field is None else "PSFs that vary over the picture are rendered cell by cell"

    def render(self, scene: LayeredScene) -> Tensor:
        """Return the rendered light, for occlusion in float64 where the device has it."""
        if scene.compositing == "occlusion":
            planes = occlusion_planes(scene)
            return occlude_whole(planes, PART_BYTES) if _is_whole(scene) else occlude_tiles(planes, self.plan(scene))
        sums = self._sums(scene)
        if scene.compositing == "gather":
            return sums.gather(scene.plane)
        return seen(scene, sums.scatter(scene.plane))

    def gradients(self, scene: LayeredScene, gradient: Tensor) -> GradientPairs:
        """Return the gradients of the planes, of the PSFs and of the layers' weights."""
        if scene.compositing != "occlusion":
            return blend_gradients(scene, self._sums(scene), gradient)
        planes = occlusion_planes(scene)
        if _is_whole(scene):
            return whole_gradients(planes, gradient, PART_BYTES)
        return tile_gradients(planes, self.plan(scene), gradient)

    def _sums(self, scene: LayeredScene) -> LayerSums:
        if _is_whole(scene):
            return WholeSums(scene, PART_BYTES)
        return TileSums(scene, self.plan(scene), self.together(scene, self.grid(scene)))

    def work(self, scene: LayeredScene) -> Work:
        """Return the work, on a processor with the layers in every eighth row and column of the tiles."""
        every = len(scene.psfs)
        if _is_whole(scene):
            return dense_work(scene, every, at_once=every)
        labels, channels, grid = scene.labels, scene.image.shape[1], self.grid(scene)
        pairs, layers, most = grid.blocks * every, every, every
        if scene.image.device.type == "cpu":
            held = grid.present(labels.every(SAMPLE), every, SAMPLE)
            pairs, layers, most = (int(number) for number in (held.sum(), held.any(0).sum(), held.sum(1).max()))
        image = channels * labels.layer_index.numel() * scene.image.element_size()
        samples, transform = math.prod(grid.size), 2 * transform_operations(*grid.size)  # of complex planes
        plane, chunk = channels * self._plane_bytes(scene, grid), self._chunk_bytes(scene)
        if scene.compositing == "occlusion":  # in float64, where operations take twice as long
            operations = 2 * ((4 * channels + 2) * transform + 3 * channels * _PRODUCT * samples) * pairs
            memory = 2 * layers * plane + max(chunk, _OCCLUSION_PLANES * plane * most)
            return Work(operations, memory + 2 * image + 32 * labels.layer_index.numel(), max(grid.size))
        operations = transform * (grid.blocks + pairs + layers) + _PRODUCT * samples * pairs
        operations *= channels * scene.image.element_size() // 4
        memory = 2 * layers * plane + max(chunk, _PLANES * plane * most // channels)
        return Work(operations, memory + 4 * image + 16 * labels.layer_index.numel(), max(grid.size))

    def grid(self, scene: LayeredScene) -> Grid:
        """Return the tiles of a scene: in windows of some 2.5 P pixels, or as few as an accelerator's memory allows.

        Larger tiles waste less on their overlap, smaller ones hold fewer layers.
        """
        occludes, side, batch = scene.compositing == "occlusion", scene.psfs.shape[-1], len(scene.image)
        height, width = scene.padded_size if scene.compositing == "scatter" else scene.output_size
        half = -(-width // 2)
        if scene.image.device.type == "cpu":
            sizes = count(max(self.smallest, -(-5 * side // (2 * _STEP)) * _STEP), _STEP)
            size = next(size for size in sizes if next_fast_size(size) == size)
            sides = needed_side(size, height, side, _STEP), needed_side(size, half, side, _STEP)
            return Grid(batch, (height, width), side - 1, sides, 2, occludes)
        tile = height
        while True:
            sides = next_fast_size(tile + side - 1), next_fast_size(half + side - 1)
            grid = Grid(batch, (height, width), side - 1, sides, 2, occludes)
            if tile <= side or self._pairs(scene, grid) >= len(scene.psfs):
                return grid
            tile = -(-tile // 2)

    def plan(self, scene: LayeredScene) -> Plan:
        """Return the pairs of blocks and layers of a scene, in chunks."""
        keep_memory()
        grid = self.grid(scene)
        return plan_pairs(grid, scene.labels, len(scene.psfs), self._pairs(scene, grid) // self.together(scene, grid))

    def together(self, scene: LayeredScene, grid: Grid) -> int:
        """Return the channels that gather and scatter work on together: one, or all where memory allows."""
        every, channels = scene.psfs.shape[:2]
        if scene.compositing == "occlusion" or scene.image.device.type == "cpu":
            return 1
        return channels if every * channels <= self._pairs(scene, grid) else 1

    def _pairs(self, scene: LayeredScene, grid: Grid) -> int:
        """Return how many pairs fit into a chunk: in one channel, or for occlusion in all of them."""
        planes = _OCCLUSION_PLANES * scene.image.shape[1] if scene.compositing == "occlusion" else _PLANES
        return self._chunk_bytes(scene) // (planes * self._plane_bytes(scene, grid))

    def _chunk_bytes(self, scene: LayeredScene) -> int:
        return self.chunk_bytes if scene.image.device.type == "cpu" else PART_BYTES

    def _plane_bytes(self, scene: LayeredScene, grid: Grid) -> int:
        dtype = widest(scene.image.device) if scene.compositing == "occlusion" else scene.image.dtype
        return math.prod(grid.size) * dtype.to_complex().itemsize


def _is_whole(scene: LayeredScene) -> bool:
    """Return whether whole planes are worked on: on an accelerator, while they are not too large for it."""
    samples = len(scene.psfs) * math.prod((*scene.image.shape[:2], *scene.padded_size))
    return scene.image.device.type != "cpu" and samples <= MOST_SAMPLES
