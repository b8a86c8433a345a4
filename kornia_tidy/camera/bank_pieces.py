"""Captures through a PSF bank in pieces: some layers at a time, where all of them would exceed the memory allowed.

Gather and scatter are sums over layers. Each pixel lies between two neighbouring layers, so a piece of consecutive
layers renders the pixels between its first and its last one, and the pieces together make the capture. Layers that the
scene does not hold are left out. Occlusion needs all layers of a state of the modulator at once; its pieces are states.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from kornia_tidy.camera.exposure import Banks, render_banks
from kornia_tidy.camera.samples import Sample, cropped
from kornia_tidy.psf.defocus_interpolation import nodes_around
from kornia_tidy.psf.exact import without_kernel_cache
from kornia_tidy.psf.psf_model import PSFModel
from kornia_tidy.render.borders import next_fast_size
from kornia_tidy.runtime.reading import is_unread
from kornia_tidy.runtime.tracing import is_followed

LEAST_BYTES = 12 << 20  # allowed to a piece whatever the budget
_COPIES = 4  # of PSFs, while a bank is computed, stacked and normalised
_TILE = 4  # side of the tiles' transforms over that of the PSFs: with smaller tiles their overlap is most of them
_POINTS = 100  # bytes for each pixel along a PSF's side and each mask pixel: the matrices of the propagation


@dataclass(frozen=True, eq=False)
class BankPieces:
    """PSFs of a scene that are computed in pieces.

    Args:
        model: makes them.
        channels: of the image.
        dtype: float32 or float64.
        most_layers: of a piece, at least 2.
        remembered: whether PSFs are kept from capture to capture.
    """

    model: PSFModel
    channels: int
    dtype: torch.dtype
    most_layers: int
    remembered: bool

    def banks(self, defocus: Tensor, state: int | None = None) -> Banks:
        """Return the PSFs between the lowest and the highest defocus, of all states or of one.

        Args:
            defocus: in radians.
            state: index among the states of the modulator. Default: their average.
        """
        model = self.model if state is None else self.model.through_state(state)
        if self.remembered:
            return model.scene_banks(self.channels, self.dtype, defocus)
        with without_kernel_cache():
            return model.without_memory().scene_banks(self.channels, self.dtype, defocus)


def pieces_for(camera: Any, channels: int, dtype: torch.dtype, reach: Tensor) -> BankPieces | None:
    """Return how to compute the PSFs of a scene in pieces; None where all of them fit the memory allowed at once.

    Half of the camera's ``memory_budget`` is for PSFs and their spectra, but at least :data:`LEAST_BYTES`. PSFs that
    were measured or are interpolated over defocus come as a whole, and so do all on accelerators and in compiled code.

    Args:
        camera: a :class:`~kornia_tidy.TiDyOptics` as it is at one moment.
        channels: of the image.
        dtype: float32 or float64.
        reach: lowest and highest defocus of the scene in radians, or its map.
    """
    model = camera.psf_model
    if is_followed() or is_unread() or not reach.numel() or model.measured is not None:
        return None
    kind = model.fidelity.layers
    if kind not in ("nearest", "linear") or (layers := len(nodes_around(model.defocus_nodes, reach))) < 3:
        return None
    psfs, work = layer_bytes(model, channels, dtype)
    allowed = max(camera.memory_budget // 2, LEAST_BYTES)
    if camera.compositing == "occlusion":
        states = len(model.state_weights(dtype)) if model.fidelity.occlusion_states == "each" else 1
        if states == 1 or states * layers * psfs <= allowed:
            return None
        return BankPieces(model, channels, dtype, layers, remembered=False)
    if layers * (psfs + work) <= allowed:
        return None
    return BankPieces(model, channels, dtype, max(2, allowed // (psfs + work)), layers * psfs <= allowed)


def image_budget(camera: Any, sample: Sample) -> int:
    """Return the bytes for rendering an image: half of the camera's budget where PSFs may come in pieces, else all.

    Args:
        camera: a :class:`~kornia_tidy.TiDyOptics` as it is at one moment.
        sample: image and depth.
    """
    budget: int = camera.memory_budget
    if sample.bytes_at_once <= budget // 2:
        return budget
    reach = torch.tensor(camera.psf_model.camera.defocus_range, dtype=torch.float64)
    return budget if pieces_for(camera, sample.image.shape[1], sample.dtype, reach) is None else budget // 2


def layer_bytes(model: PSFModel, channels: int, dtype: torch.dtype) -> tuple[int, int]:
    """Return the bytes that a layer takes: of its PSFs, and of their computation and their spectra.

    Args:
        model: of the PSFs.
        channels: of the image.
        dtype: float32 or float64.

    Example:
        >>> from kornia_tidy import Fidelity
        >>> psfs, work = layer_bytes(PSFModel(fidelity=Fidelity(window=65)), 3, torch.float32)
        >>> psfs >> 10, work >> 20
        (198, 2)
    """
    side, cells = model.window, model.pupil.amplitude.shape[-1]
    planes = channels * len(model.spectrum.basis or (1,))
    tile = next_fast_size(_TILE * side)
    psfs = _COPIES * planes * side**2 * dtype.itemsize
    work = 2 * planes * tile**2 * dtype.itemsize + 2 * side * cells**2 * dtype.itemsize + _POINTS * side * cells
    return psfs, work


def render_pieces(light: Tensor, defocus: Tensor, pieces: BankPieces, camera: Any, border: str) -> Tensor:
    """Return the irradiance of a scene, rendered piece by piece; gradients compute each piece again.

    Args:
        light: (B, C, H, W) linear light.
        defocus: (B, 1, H, W) or (1, 1, H, W) radians.
        pieces: PSFs.
        camera: says how to render.
        border: what lies beyond the image.
    """
    compositing, fidelity = camera.compositing, camera.psf_model.fidelity

    def render(light: Tensor, defocus: Tensor, reach: Tensor, state: int | None = None) -> Tensor:
        banks = pieces.banks(reach, state)
        return render_banks(light, defocus, banks, fidelity, compositing, border, "auto")

    total: Any = 0
    if compositing == "occlusion":
        for state, share in enumerate(pieces.model.state_weights(pieces.dtype)):
            total = total + share * _recomputed(render, light, defocus, defocus, state)
        return total
    margin = pieces.model.window // 2 if border == "valid" else 0
    gathers = compositing == "gather"
    for reach, inside in _parts(defocus, pieces, margin if gathers else 0):
        # Pixels of other pieces are those of one layer, which costs least.
        own_defocus = torch.where(inside, defocus, reach[0].to(defocus))
        if gathers:
            total = torch.where(cropped(inside, margin), _recomputed(render, light, own_defocus, reach), total)
        else:
            total = total + _recomputed(render, light * inside, own_defocus, reach)
    return total


def _parts(defocus: Tensor, pieces: BankPieces, margin: int) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield the first and last layer's defocus of each piece, (2,) float64, and which pixels are its own."""
    nodes = defocus.new_tensor(pieces.model.defocus_nodes, dtype=torch.float64)
    interval = torch.bucketize(defocus.detach().double(), nodes[1:-1].contiguous(), right=True, out_int32=True)
    present = torch.bincount(cropped(interval, margin).flatten(), minlength=len(nodes) - 1) > 0
    for first, last in runs_of(present.tolist(), pieces.most_layers - 1):
        yield torch.stack([nodes[first], nodes[last]]), (interval >= first) & (interval < last)


def runs_of(present: list[bool], most: int) -> list[tuple[int, int]]:
    """Return begin and end of runs of consecutive present entries, of at most so many.

    Example:
        >>> runs_of([True, True, True, False, True], 2)
        [(0, 2), (2, 3), (4, 5)]
    """
    edges = [i for i, (before, own) in enumerate(pairwise([False, *present, False])) if before != own]
    runs = zip(edges[::2], edges[1::2], strict=True)
    return [(start, min(start + most, stop)) for first, stop in runs for start in range(first, stop, most)]


def _recomputed(render: Any, light: Tensor, *arguments: Any) -> Tensor:
    """Return a piece, of which only the arguments are kept for the backward pass."""
    if not torch.is_grad_enabled():
        return render(light, *arguments)
    return checkpoint(render, light, *arguments, use_reentrant=False, preserve_rng_state=False)
