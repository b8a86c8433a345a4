r"""Rendering through PSFs that vary over the picture, without seams: in tiles of the compiled backend, or in cells.

The PSF of a pixel is interpolated between nodes over the field (:class:`kornia_tidy.psf.field.Field`). Within a cell it
is taken to first order about the cell's middle:

.. math:: h(y, x) = h_0 + y\, h_y + x\, h_x, \qquad \mathcal{R}(L; h) = \mathcal{R}(L; h_0) + y\,\mathcal{R}(L; h_y)
    + x\,\mathcal{R}(L; h_x)

Gather is linear in the PSFs, so that any backend renders a cell. In scatter the PSF is that of the pixel where light
comes from, and its factors y and x stand before the sum. Occlusion divides, so the planes that it divides are blended
and not the pictures: the PSF is that of the pixel that sees. Compiled occlusion has gradients of light and PSFs; with
that of defocus all are the gradients of cells, for the light that the compiled code renders.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from torch import Tensor
from torch.nn.functional import pad

from kornia_tidy.kernels.build import compiled
from kornia_tidy.kernels.overlap_ops import SOURCE
from kornia_tidy.mode import torch_mode
from kornia_tidy.psf.field import Field
from kornia_tidy.psf.field_bank import FieldBank
from kornia_tidy.psf.psf_cache import nodes_around
from kornia_tidy.render.backend import wants_gradient
from kornia_tidy.render.backends.dense_occlusion import occlude_dense
from kornia_tidy.render.borders import check_border, cropped, pad_border
from kornia_tidy.render.dispatch import BACKENDS, Rendering, render_layers
from kornia_tidy.render.scene import assign_layers, layered_scene
from kornia_tidy.render.stray_light import spread_evenly


def render_over_field(light: Tensor, defocus: Tensor, bank: FieldBank, field: Field, rendering: Rendering) -> Tensor:
    """Render a scene through PSFs that are known at the nodes of a field.

    Args:
        light: (B, C, H, W) linear light.
        defocus: (B, 1, H, W) or (1, 1, H, W) radians.
        bank: PSFs at the nodes of the field, in their order.
        field: where the nodes stand, and where in the picture the light's first pixel is.
        rendering: how.

    Returns:
        (B, C, h, w). Gradients reach light, defocus and PSFs.

    Raises:
        ValueError: if the image is too small for the border, or stray light is to be spread with occlusion.

    Example:
        >>> field, light, even = Field((8, 8), (2, 2)), torch.ones(1, 1, 8, 8), torch.ones(4, 1, 1)
        >>> psfs = torch.tensor([0.0, 1.0, 0.0, 1.0]).view(4, 1, 1, 1, 1)  # brighter to the right
        >>> bank = FieldBank(psfs, torch.zeros(1), torch.tensor(field.points), even, even)
        >>> seen = render_over_field(light, torch.zeros(1, 1, 8, 8), bank, field, Rendering("gather", "reflect"))
        >>> seen[0, 0, 3, 1:].round(decimals=2)
        tensor([0.1400, 0.2900, 0.4300, 0.5700, 0.7100, 0.8600, 1.0000])
    """
    radius, border = bank.window // 2, rendering.border
    check_border(border, *light.shape[-2:], bank.window)
    occludes = rendering.compositing == "occlusion"
    if occludes and bank.veil is not None:
        raise ValueError(
            "stray_light 'veil' cannot be spread behind things that hide where PSFs vary over the picture: take a "
            "fidelity with stray_light='renormalize' or 'discard', or compositing 'gather' or 'scatter'"
        )
    if occludes:  # which divides by the PSFs' light
        bank = bank.with_all_light()
    alike, tiled = field.nodes == (1, 1) and not occludes, None
    if alike or _is_compiled(light, defocus, bank, field, rendering):
        given = light, defocus, bank.defocus, bank.psfs[0] if alike else bank.psfs, None
        whole = not (occludes and torch.is_grad_enabled() and wants_gradient(defocus))
        with torch.set_grad_enabled(whole and torch.is_grad_enabled()):
            tiled = render_layers(*given, rendering, field=None if alike else field)
        if whole:
            return tiled if bank.veil is None else tiled + _veil(light, defocus, bank, field, rendering)
    plane, deep, inside, around = light, defocus, None, field
    if border != "valid":
        plane = pad_border(light, radius, border)
        deep = pad_border(defocus, radius, "replicate" if border == "zero" else border)
        around = field.moved(-radius, -radius)
    if occludes and border == "zero":
        inside = pad_border(torch.ones_like(light[:1, 0]), radius, "zero")
    cells = _Cells(bank, around, rendering)
    seen = cells.scatter(plane, deep) if rendering.compositing == "scatter" else cells.see(plane, deep, inside)
    if tiled is not None:
        seen = seen + (tiled - seen).detach()
    return seen if bank.veil is None else seen + _veil(light, defocus, bank, field, rendering)


def _is_compiled(light: Tensor, defocus: Tensor, bank: FieldBank, field: Field, rendering: Rendering) -> bool:
    """Return whether the compiled backend takes PSFs over the field: elsewhere cells are rendered."""
    dtype = torch.promote_types(torch.promote_types(light.dtype, bank.psfs.dtype), torch.float32)
    if torch_mode() or light.device.type != "cpu" or compiled(SOURCE, dtype) is None:
        return False
    if rendering.compositing != "occlusion":
        return True
    options = rendering.layers, rendering.border, rendering.correlate
    scene = layered_scene(light, defocus, bank.defocus, bank.psfs.detach(), None, "occlusion", *options, field)
    return BACKENDS["compiled"].refusal(scene) is None


def _veil(light: Tensor, defocus: Tensor, bank: FieldBank, field: Field, rendering: Rendering) -> Tensor:
    """Return the stray light, as :func:`kornia_tidy.render.stray_light.stray_light_of` has it for one PSF a layer."""
    assert bank.veil is not None
    taken = replace(bank, psfs=bank.veil[..., None, None], veil=None)  # PSFs of one pixel
    whole = replace(rendering, compositing="gather", border="reflect", correlate=False)
    if rendering.compositing == "scatter":
        return spread_evenly(_Cells(taken, field, whole).see(light, defocus), bank.window, rendering.border)
    spread = spread_evenly(light, bank.window, rendering.border).expand_as(light)
    seen = _Cells(taken, field, whole).see(spread, defocus)
    return cropped(seen, bank.window // 2 if rendering.border == "valid" else 0)


@dataclass(frozen=True)
class _Steps:
    """A cell along an axis.

    Args:
        pixels: of the plane.
        weights: of the nodes for the first order in the cell, (2, nodes).
        offset: of the pixels from the middle.
    """

    pixels: slice
    weights: Tensor
    offset: Tensor


class _Cells:
    """The PSFs of cells, and the pixels seen through them. Planes hold the border that PSFs reach."""

    def __init__(self, bank: FieldBank, field: Field, rendering: Rendering) -> None:
        self.field, self.rendering, self.bank = field, rendering, bank
        self.nodes, self.radius = tuple(bank.defocus.tolist()), bank.window // 2
        self.psfs = bank.psfs.movedim(1, 0).contiguous()  # (D, F, C, P, P)

    def _columns(self, deep: Tensor, margin: int) -> list[tuple[_Steps, Tensor]]:
        """Return the cells along a row, and how value and slopes there follow from those at its nodes, (3, 2 nx)."""
        found = []
        for across in self._steps(1, deep, margin):
            weights, slopes = across.weights.split(1)
            none = torch.zeros_like(weights)
            mixing = torch.cat([torch.cat([weights, none, slopes]), torch.cat([none, weights, none])], 1)
            found.append((across, mixing.to(self.psfs)))
        return found

    def see(self, plane: Tensor, deep: Tensor, inside: Tensor | None = None) -> Tensor:
        """Return the pixels rendered by gather or occlusion, (B, C, h, w)."""
        radius, lines, columns = self.radius, [], self._columns(deep, self.radius)
        for down, line in self._lines(deep, radius):
            parts = []
            for across, mixing in columns:
                around = ..., _wider(down.pixels, radius), _wider(across.pixels, radius)
                window, depths = plane[around], deep[around]
                own = self._layers(cropped(depths, radius) if self.rendering.compositing == "gather" else depths)
                psfs, factors = self._psfs(line, mixing, own), _factors(down, across)
                if self.rendering.compositing == "gather":
                    seen = self._rendered(window.repeat(1, 3, 1, 1), depths, own, psfs.flatten(1, 2), "valid")
                    seen = (seen.unflatten(1, (3, -1)) * factors[:, None]).sum(1)
                else:
                    index, weight = assign_layers(depths[:, 0], self.bank.defocus[own], self.rendering.layers)
                    shown = None if self.rendering.layers == "nearest" else weight
                    psfs = (psfs.flip((-2, -1)) if self.rendering.correlate else psfs).transpose(0, 1)
                    dark = None if inside is None else inside[around]
                    seen = occlude_dense(window, psfs, shown, None, None, index, dark, factors).to(window.dtype)
                parts.append(seen)
            lines.append(torch.cat(parts, -1))
        return torch.cat(lines, -2)

    def scatter(self, plane: Tensor, deep: Tensor) -> Tensor:
        """Return where the light of a plane goes, less the plane's rim, (B, C, h, w)."""
        radius = self.radius
        columns = self._columns(deep, 0)
        total = plane.new_zeros(*plane.shape[:2], *(side + 2 * radius for side in plane.shape[-2:]))
        for down, line in self._lines(deep, 0):
            for across, mixing in columns:
                window, depths = (x[..., down.pixels, across.pixels] for x in (plane, deep))
                own = self._layers(depths)
                psfs = self._psfs(line, mixing, own).flatten(1, 2)
                parts = (window[:, None] * _factors(down, across)[:, None]).flatten(1, 2)
                parts, depths = pad(parts, (radius,) * 4), pad(depths, (radius,) * 4, mode="replicate")
                spread = self._rendered(parts, depths, own, psfs, "zero").unflatten(1, (3, -1)).sum(1)
                total[..., _wider(down.pixels, radius), _wider(across.pixels, radius)] += spread
        return cropped(total, 2 * radius)

    def _rendered(self, light: Tensor, depths: Tensor, own: slice, psfs: Tensor, border: str) -> Tensor:
        return render_layers(light, depths, self.bank.defocus[own], psfs, None, replace(self.rendering, border=border))

    def _lines(self, deep: Tensor, margin: int) -> Iterator[tuple[_Steps, tuple[int, Tensor]]]:
        """Yield rows of cells with their PSFs at the nodes along the rows, values and slopes, (D, 2 nx, C P P)."""
        for down in self._steps(0, deep, margin):
            weights = down.weights.to(self.psfs)
            whole = self.psfs.view(len(self.psfs), self.field.nodes[0], -1)
            own = self._layers(deep[..., _wider(down.pixels, margin), :])
            rows = (weights @ whole[own]).view(own.stop - own.start, 2 * self.field.nodes[1], -1)
            yield down, (own.start, rows)

    def _psfs(self, line: tuple[int, Tensor], mixing: Tensor, own: slice) -> Tensor:
        """Return value and slopes of the PSFs of a cell, (D, 3, C, P, P)."""
        first, rows = line
        part = rows[own.start - first : own.stop - first]
        return (mixing @ part).unflatten(2, self.psfs.shape[2:])

    def _steps(self, axis: int, deep: Tensor, margin: int) -> Iterator[_Steps]:
        """Yield the cells along an axis. They stand at the same places of the picture whatever part of it is seen."""
        first, pixels = self.field.origin[axis] + margin, deep.shape[axis - 2] - 2 * margin
        beyond = self.radius if self.rendering.compositing == "scatter" else 0
        edges, middles, weights = self.field.tiles(axis, first, pixels, self.field.cell, beyond)
        for own, middle, there in zip(pairwise(edges.tolist()), middles.tolist(), weights, strict=True):
            yield _Steps(slice(*own), there, (torch.arange(*own) - middle).to(self.psfs))

    def _layers(self, depths: Tensor) -> slice:
        """Return the layers that pixels need; all where one would have to wait for their values."""
        held = self.nodes if torch_mode() else nodes_around(self.nodes, depths)
        first = self.nodes.index(held[0])
        return slice(first, first + len(held))


def _wider(pixels: slice, radius: int) -> slice:
    return slice(pixels.start, pixels.stop + 2 * radius)


def _factors(down: _Steps, across: _Steps) -> Tensor:
    """Return what value and slopes of the PSFs are multiplied by at each pixel of a cell, (3, h, w): 1, y and x."""
    y, x = torch.meshgrid(down.offset, across.offset, indexing="ij")
    return torch.stack([torch.ones_like(y), y, x])
