"""The tiled backend: each tile is convolved by transforms with the PSFs of the layers it contains and with no other.

For the backward pass nothing is kept; spectra are computed again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from kornia_tidy.render.backend import GradientPairs, Work, transform_operations
from kornia_tidy.render.backends.allocator import keep_memory
from kornia_tidy.render.backends.block_plan import plan_blocks
from kornia_tidy.render.backends.dense_occlusion import occlusion_planes
from kornia_tidy.render.backends.layer_sums import blend_gradients, seen
from kornia_tidy.render.backends.tile_plan import BLOCKS, WINDOWS, Grid, TileKind, tile_grid
from kornia_tidy.render.backends.tile_workspace import TileWorkspace
from kornia_tidy.render.backends.tiled_occlusion import occlude_tiled, occlusion_gradients
from kornia_tidy.render.scene import SAMPLE, LayeredScene

_PRODUCT = 6  # operations of a complex product
_OCCLUSION_PLANES = 6  # of a chunk at a time: light, spectra, products and quotients; 0.99 to 1.46 of the measured peak


@dataclass(frozen=True)
class TiledBackend:
    """Convolution of tiles by transforms. See :class:`kornia_tidy.render.backend.Backend`.

    Args:
        blocks: tiles of gather and scatter.
        windows: tiles of occlusion.
    """

    blocks: TileKind = BLOCKS
    windows: TileKind = WINDOWS

    name = "tiled"

    def refusal(self, scene: LayeredScene) -> None:
        """Return None: it supports every scene."""

    def render(self, scene: LayeredScene) -> Tensor:
        """Return the rendered light."""
        keep_memory()
        kind, grid = self.tiles(scene)
        if scene.compositing == "occlusion":
            return occlude_tiled(occlusion_planes(scene), scene.labels, grid, kind)
        sums = _Sums(scene, kind, grid)
        if scene.compositing == "gather":
            return sums.gather(scene.plane)
        return seen(scene, sums.scatter(scene.plane))

    def gradients(self, scene: LayeredScene, gradient: Tensor) -> GradientPairs:
        """Return the gradients of the padded planes and of the PSFs."""
        keep_memory()
        kind, grid = self.tiles(scene)
        if scene.compositing == "occlusion":
            return occlusion_gradients(occlusion_planes(scene), scene.labels, grid, kind, gradient)
        return blend_gradients(scene, _Sums(scene, kind, grid), gradient)

    def work(self, scene: LayeredScene) -> Work:
        """Return the work, with the layers in every eighth row and column of the tiles."""
        labels, channels, (kind, grid) = scene.labels, scene.image.shape[1], self.tiles(scene)
        held = grid.present(labels.every(SAMPLE), len(scene.psfs), SAMPLE)
        pairs, layers, most = (int(number) for number in (held.sum(), held.any(0).sum(), held.sum(1).max()))
        image = channels * labels.layer_index.numel() * scene.image.element_size()
        transform = 2 * transform_operations(grid.size, grid.size)  # of complex planes
        if scene.compositing == "occlusion":  # in float64, where operations take twice as long
            plane = 16 * channels * grid.size**2
            operations = 2 * channels * (2 * transform + _PRODUCT * grid.size**2) * pairs
            chunk = _OCCLUSION_PLANES * max(kind.chunk_bytes, 2 * plane * most)
            return Work(operations, 2 * layers * plane + chunk + 2 * image + 32 * labels.layer_index.numel(), grid.size)
        plane = 2 * scene.image.element_size() * grid.size**2
        operations = transform * (grid.blocks + pairs + layers) + _PRODUCT * grid.size**2 * pairs
        operations *= channels * scene.image.element_size() // 4
        chunk = 3 * max(kind.chunk_bytes, plane * math.ceil(pairs / grid.blocks))
        memory = 2 * layers * channels * plane + chunk + 4 * image + 16 * labels.layer_index.numel()
        return Work(operations, memory, grid.size)

    def tiles(self, scene: LayeredScene) -> tuple[TileKind, Grid]:
        """Return the kind of the tiles of a scene, and the tiles."""
        kind = self.windows if scene.compositing == "occlusion" else self.blocks
        return kind, tile_grid(tuple(scene.labels.layer_index.shape), scene.psfs.shape[-1], kind)


class _Sums:
    """See :class:`kornia_tidy.render.backends.layer_sums.LayerSums`. Spectra are computed once for all three sums."""

    def __init__(self, scene: LayeredScene, kind: TileKind, grid: Grid) -> None:
        lost = scene.psfs.shape[-1] - 1
        offset = 0 if scene.compositing == "scatter" else lost  # of a tile in its window
        self.grid, self.lost = grid, lost
        self.plan = plan_blocks(scene.labels, len(scene.psfs), grid, kind, offset)
        self.work = TileWorkspace(self.plan, scene.psfs.detach())

    def gather(self, plane: Tensor, *, correlate: bool = False, weight_gradient: bool = False) -> Tensor:
        work, spectra = self.work, self.work.conjugate if correlate else self.work.spectra
        blended = plane.new_empty(*plane.shape[:2], self.grid.height, self.grid.width)
        for chunk in self.plan.chunks:
            offsets = work.offsets(chunk)
            for c in range(plane.shape[1]):
                light = torch.fft.fft2(work.windows(plane[:, c], chunk))
                blurred = torch.fft.ifft2(work.blur(light, spectra[c], chunk))
                work.gather_from_planes(blended[:, c][chunk.pixels], blurred, offsets, weight_gradient=weight_gradient)
        return blended

    def scatter(self, pixels: Tensor, *, correlate: bool = False) -> Tensor:
        work, spectra = self.work, self.work.conjugate if correlate else self.work.spectra
        full = work.tiled_plane(pixels)
        for chunk in self.plan.chunks:
            offsets = work.offsets(chunk)
            for c in range(pixels.shape[1]):
                own = torch.fft.fft2(work.scatter_to_planes(pixels[:, c][chunk.pixels], offsets, chunk))
                work.add_windows(full[:, c], torch.fft.ifft2(work.sum_layers(own, spectra[c], chunk)), chunk)
        return full[..., : self.grid.height + self.lost, : self.grid.width + self.lost]

    def psf_gradient(self, plane: Tensor, pixels: Tensor, *, correlate: bool = False) -> Tensor:
        work = self.work
        sums = work.no_spectra()
        for chunk in self.plan.chunks:
            offsets = work.offsets(chunk)
            for c in range(plane.shape[1]):
                own = torch.fft.fft2(work.scatter_to_planes(pixels[:, c][chunk.pixels], offsets, chunk))
                light = torch.fft.fft2(work.windows(plane[:, c], chunk))
                work.correlate(sums[c], light, own, chunk)
        return work.psfs_of(sums.conj() if correlate else sums)
