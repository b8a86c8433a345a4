"""The tiled backend: each tile is convolved by transforms with the PSFs of the layers it contains and with no other.

For the backward pass nothing is kept; spectra are computed again.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from kornia_tidy.render.backend import GradientPairs, Work, gradient_pairs, transform_operations, wants_gradient
from kornia_tidy.render.backends.allocator import keep_memory
from kornia_tidy.render.backends.block_plan import BlockPlan, plan_blocks
from kornia_tidy.render.backends.dense_occlusion import occlusion_planes
from kornia_tidy.render.backends.tile_plan import BLOCKS, WINDOWS, Grid, TileKind, tile_grid
from kornia_tidy.render.backends.tile_workspace import TileGradients, TileWorkspace
from kornia_tidy.render.backends.tiled_occlusion import occlude_tiled, occlusion_gradients
from kornia_tidy.render.borders import pad_border
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
        labels, layers, (kind, grid) = scene.labels, len(scene.psfs), self.tiles(scene)
        if scene.compositing == "occlusion":
            return occlude_tiled(occlusion_planes(scene), labels, grid, kind)
        if scene.compositing == "scatter":
            return _scatter(scene.plane, scene.psfs, plan_blocks(labels, layers, grid, kind, offset=0))
        plane = pad_border(scene.image, scene.psfs.shape[-1] // 2, scene.border, grid.spare)
        return _gather(plane, scene.psfs, plan_blocks(labels, layers, grid, kind, scene.psfs.shape[-1] - 1))

    def gradients(self, scene: LayeredScene, gradient: Tensor) -> GradientPairs:
        """Return the gradients of the padded planes and of the PSFs."""
        keep_memory()
        labels, layers, (kind, grid) = scene.labels, len(scene.psfs), self.tiles(scene)
        if scene.compositing == "occlusion":
            return occlusion_gradients(occlusion_planes(scene), labels, grid, kind, gradient)
        scatters = scene.compositing == "scatter"
        plan = plan_blocks(labels, layers, grid, kind, 0 if scatters else scene.psfs.shape[-1] - 1)
        plane = pad_border(scene.image, scene.psfs.shape[-1] // 2, scene.border, (0, 0) if scatters else grid.spare)
        tensors = plane, scene.psfs, scene.batch_weight
        wanted = [wants_gradient(x) for x in tensors]
        gradients = _scatter_gradients if scatters else gather_gradients
        return gradient_pairs(tensors, gradients(tensors[0].detach(), scene.psfs.detach(), gradient, plan, wanted))

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


def _gather(plane: Tensor, psfs: Tensor, plan: BlockPlan) -> Tensor:
    work = TileWorkspace(plan, psfs)
    blended = plane.new_empty(*plane.shape[:2], plan.grid.height, plan.grid.width)
    for chunk in plan.chunks:
        offsets = work.offsets(chunk)
        for c in range(psfs.shape[1]):
            light = torch.fft.fft2(work.windows(plane[:, c], chunk))
            blurred = torch.fft.ifft2(work.blur(light, work.spectra[c], chunk))
            work.gather_from_planes(blended[:, c][chunk.pixels], blurred, offsets)
    return blended


@torch.no_grad()
def gather_gradients(
    plane: Tensor, psfs: Tensor, grad: Tensor, plan: BlockPlan, wanted: Sequence[bool]
) -> tuple[Tensor | None, Tensor | None, Tensor | None]:
    """Return the gradients of gathered light with respect to plane, PSFs and layer weight, where they are wanted.

    Args:
        plane: (B, C, H + P - 1, W + P - 1) light, or larger.
        psfs: (D, C, P, P).
        grad: (B, C, H, W) gradient of the gathered light.
        plan: tiles of the (B, H, W) pixels.
        wanted: of plane, PSFs and layer weight.
    """
    work = TileWorkspace(plan, psfs)
    gradients = TileGradients(wanted, plane, work)
    full = work.tiled_plane(plane) if gradients.plane else None
    for chunk in plan.chunks:
        offsets = work.offsets(chunk)
        for c in range(psfs.shape[1]):
            if gradients.plane or gradients.psfs is not None:
                own = torch.fft.fft2(work.scatter_to_planes(grad[:, c][chunk.pixels], offsets, chunk))
            if gradients.layer_weight is not None or gradients.psfs is not None:
                light = torch.fft.fft2(work.windows(plane[:, c], chunk))
            if gradients.layer_weight is not None:
                blurred = torch.fft.ifft2(work.blur(light, work.spectra[c], chunk))
                gradients.add_layer_weight(blurred, grad[:, c][chunk.pixels], offsets, chunk)
            if gradients.psfs is not None:
                gradients.add_psfs(light, own, chunk, c)
            if full is not None:
                work.add_windows(full[:, c], torch.fft.ifft2(work.sum_layers(own, work.conjugate[c], chunk)), chunk)
    if full is not None:
        full = full[..., : plane.shape[-2], : plane.shape[-1]]
    return full, gradients.of_psfs(psfs, conjugate=False), gradients.layer_weight


def _scatter(plane: Tensor, psfs: Tensor, plan: BlockPlan) -> Tensor:
    work = TileWorkspace(plan, psfs)
    full = work.tiled_plane(plane)
    for chunk in plan.chunks:
        offsets = work.offsets(chunk)
        for c in range(psfs.shape[1]):
            own = torch.fft.fft2(work.scatter_to_planes(plane[:, c][chunk.pixels], offsets, chunk))
            work.add_windows(full[:, c], torch.fft.ifft2(work.sum_layers(own, work.spectra[c], chunk)), chunk)
    return full[..., psfs.shape[-1] - 1 : plane.shape[-2], psfs.shape[-1] - 1 : plane.shape[-1]]


@torch.no_grad()
def _scatter_gradients(
    plane: Tensor, psfs: Tensor, grad: Tensor, plan: BlockPlan, wanted: Sequence[bool]
) -> tuple[Tensor | None, Tensor | None, Tensor | None]:
    work = TileWorkspace(plan, psfs)
    gradients = TileGradients(wanted, plane, work)
    gathered = torch.empty_like(plane) if gradients.plane else None
    full = torch.nn.functional.pad(grad, (psfs.shape[-1] - 1,) * 4)
    for chunk in plan.chunks:
        offsets = work.offsets(chunk)
        for c in range(psfs.shape[1]):
            light = torch.fft.fft2(work.windows(full[:, c], chunk))
            pixels = plane[:, c][chunk.pixels]
            if gradients.psfs is not None:
                own = torch.fft.fft2(work.scatter_to_planes(pixels, offsets, chunk))
                gradients.add_psfs(light, own, chunk, c)
            if gathered is not None or gradients.layer_weight is not None:
                blurred = torch.fft.ifft2(work.blur(light, work.conjugate[c], chunk))
                if gradients.layer_weight is not None:
                    gradients.add_layer_weight(blurred, pixels, offsets, chunk)
                if gathered is not None:
                    work.gather_from_planes(gathered[:, c][chunk.pixels], blurred, offsets)
    return gathered, gradients.of_psfs(psfs, conjugate=True), gradients.layer_weight
