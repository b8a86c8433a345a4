"""The tiled backend: each tile is convolved by transforms with the PSFs of the layers it contains and with no other.

For the backward pass only the inputs are kept; spectra are computed again. Gradients that are differentiated in turn
are made by the functions of :mod:`kornia_tidy.render.backends.dense`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from kornia_tidy.render.backends.allocator import keep_memory
from kornia_tidy.render.backends.block_plan import BlockPlan, plan_blocks
from kornia_tidy.render.backends.dense import differentiable_gradients, gather_dense, scatter_dense
from kornia_tidy.render.backends.dense_occlusion import occlusion_planes
from kornia_tidy.render.backends.tile_plan import (
    BLOCKS,
    WINDOWS,
    Grid,
    TileKind,
    cheapest_grid,
    choose_grid,
    least_cost,
    tile_cost,
    transforms_cost,
    transforms_seconds,
)
from kornia_tidy.render.backends.tile_workspace import TileGradients, TileWorkspace
from kornia_tidy.render.backends.tiled_occlusion import occlude_tiled
from kornia_tidy.render.borders import pad_border
from kornia_tidy.render.layers import Labels
from kornia_tidy.render.scene import LayeredScene


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

    def seconds(self, scene: LayeredScene) -> float:
        """Return the estimated time with the best tiles for the scene."""
        cost, grid = cheapest_grid(scene.labels, len(scene.psfs), scene.psf_size, self._kind(scene))
        scene.found[self.name] = grid
        if scene.compositing != "occlusion":
            cost += tile_cost(grid.size, 0, scene.sampled_layers)  # the spectra of the PSFs
        return _seconds(scene, cost)

    def least_seconds(self, scene: LayeredScene) -> float:
        """Return the time of a scene with one layer in each tile."""
        shape = tuple(scene.labels.layer_index.shape)
        return _seconds(scene, least_cost(shape, scene.psf_size, self._kind(scene)))

    def render(self, scene: LayeredScene) -> Tensor:
        """Return the rendered light."""
        keep_memory()
        labels, layers, kind = scene.labels, len(scene.psfs), self._kind(scene)
        grid = scene.found.get(self.name) or choose_grid(labels, layers, scene.psf_size, kind)
        if scene.compositing == "occlusion":
            return occlude_tiled(occlusion_planes(scene), labels, grid, kind)
        weight = scene.sorted_layers[1]
        weight = None if weight is None else weight.expand(len(scene.image), -1, -1)
        plan = plan_blocks(labels, layers, grid, kind)
        if scene.compositing == "scatter":
            return _Scatter.apply(scene.plane, scene.psfs, weight, plan)
        return _Gather.apply(_plane_with_spare(scene, grid), scene.psfs, weight, plan)

    def _kind(self, scene: LayeredScene) -> TileKind:
        return self.windows if scene.compositing == "occlusion" else self.blocks


def _seconds(scene: LayeredScene, cost: float) -> float:
    """Return the time in seconds from the cost of the windows in nanoseconds a channel."""
    if scene.compositing != "occlusion":  # which is computed in float64 anyway
        pixels, terms = scene.labels.layer_index.numel(), 1 if scene.layer_weight is None else 2
        cost = transforms_cost(cost, pixels, terms) * scene.image.element_size() / 4
    return transforms_seconds(cost) * scene.image.shape[1]


def _plane_with_spare(scene: LayeredScene, grid: Grid) -> Tensor:
    """Return the plane with room below and on the right for tiles that hang over, where its border can fill it."""
    spare = (grid.covered_height - grid.height, grid.covered_width - grid.width)
    return pad_border(scene.image, scene.psf_size // 2, scene.border, spare)


class _Gather(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, plane: Tensor, psfs: Tensor, layer_weight: Tensor | None, plan: BlockPlan) -> Tensor:
        ctx.save_for_backward(plane, psfs, layer_weight)
        ctx.plan = plan
        work = TileWorkspace(plan, psfs, psfs.shape[-1] - 1)
        blended = plane.new_empty(*plane.shape[:2], plan.grid.height, plan.grid.width)
        for chunk, offsets, c in work.steps():
            light = torch.fft.fft2(work.windows(plane[:, c], chunk))
            blurred = torch.fft.ifft2(work.blur(light, work.spectra[c], chunk))
            work.gather_from_planes(blended[:, c][chunk.pixels], blurred, offsets)
        return blended

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        (grad,), wanted = grad_outputs, ctx.needs_input_grad
        if torch.is_grad_enabled():
            return *twice_differentiable(gather_dense, ctx.saved_tensors, ctx.plan.labels, grad, wanted), None
        plane, psfs, _ = ctx.saved_tensors
        return *gather_gradients(plane, psfs, grad, ctx.plan, wanted), None


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
    work = TileWorkspace(plan, psfs, psfs.shape[-1] - 1)
    gradients = TileGradients(wanted, plane, work)
    full = work.tiled_plane(plane) if gradients.plane else None
    for chunk, offsets, c in work.steps():
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


class _Scatter(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, plane: Tensor, psfs: Tensor, layer_weight: Tensor | None, plan: BlockPlan) -> Tensor:
        ctx.save_for_backward(plane, psfs, layer_weight)
        ctx.plan = plan
        work = TileWorkspace(plan, psfs, 0)
        full = work.tiled_plane(plane)
        for chunk, offsets, c in work.steps():
            own = torch.fft.fft2(work.scatter_to_planes(plane[:, c][chunk.pixels], offsets, chunk))
            work.add_windows(full[:, c], torch.fft.ifft2(work.sum_layers(own, work.spectra[c], chunk)), chunk)
        return full[..., psfs.shape[-1] - 1 : plane.shape[-2], psfs.shape[-1] - 1 : plane.shape[-1]]

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        (grad,), wanted = grad_outputs, ctx.needs_input_grad
        (plane, psfs, _), plan = ctx.saved_tensors, ctx.plan
        if torch.is_grad_enabled():
            return *twice_differentiable(scatter_dense, ctx.saved_tensors, plan.labels, grad, wanted), None
        work = TileWorkspace(plan, psfs, 0)
        gradients = TileGradients(wanted, plane, work)
        gathered = torch.empty_like(plane) if gradients.plane else None
        full = torch.nn.functional.pad(grad, (psfs.shape[-1] - 1,) * 4)
        for chunk, offsets, c in work.steps():
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
        return gathered, gradients.of_psfs(psfs, conjugate=True), gradients.layer_weight, None


def twice_differentiable(
    render: Callable[..., Tensor], planes: Sequence[Tensor | None], labels: Labels, grad: Tensor, wanted: Sequence[bool]
) -> list[Tensor | None]:
    """Return the gradients with respect to plane, PSFs and layer weight so that they can be differentiated in turn.

    Args:
        render: :func:`~kornia_tidy.render.backends.dense.gather_dense` or ``scatter_dense``.
        planes: plane, PSFs and layer weight. The plane may have spare rows and columns, which no pixel sees.
        labels: the layers of each pixel.
        grad: gradient of the rendered light.
        wanted: of which of the planes.
    """
    psfs = planes[1]
    assert psfs is not None
    height, width = grad.shape[-2] + psfs.shape[-1] - 1, grad.shape[-1] + psfs.shape[-1] - 1

    def rendered(plane: Tensor, psfs: Tensor, layer_weight: Tensor | None) -> Tensor:
        return render(plane[..., :height, :width], psfs, layer_weight, labels.layer_index)

    return differentiable_gradients(rendered, planes, grad, wanted[:3])
