r"""A capture as a sum over pieces of PSFs: which pieces there are, and their sum.

.. math:: I = \sum_p s_p \, \mathcal{R}(L, \psi; h_p)

Ordinarily there is one piece. There are several where the states of an exposure are rendered one by one (occlusion),
where the PSFs of all layers would not fit the memory allowed (runs of layers), and where blur is wide (groups of layers
on coarse grids). A piece computes its PSFs when it is asked for them, so that a plan of pieces costs nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from math import inf
from typing import Any, cast

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from kornia_tidy.kernels.window_sides import next_fast_size
from kornia_tidy.mode import Mode, torch_mode
from kornia_tidy.psf.field import Field
from kornia_tidy.psf.field_bank import FieldBank
from kornia_tidy.psf.psf_bank import PSFBank
from kornia_tidy.psf.psf_cache import nodes_around, present_intervals
from kornia_tidy.psf.psf_model import PSFModel
from kornia_tidy.psf.wide_blur import WideBlur
from kornia_tidy.psf.wide_psfs import held_nodes
from kornia_tidy.render.borders import check_border, cropped
from kornia_tidy.render.coarse_gather import gather_group
from kornia_tidy.render.dispatch import Rendering, render_layers
from kornia_tidy.render.over_field import render_over_field

LEAST_BYTES = 12 << 20  # allowed to a piece whatever the budget
_COPIES = 4  # of PSFs, while a bank is computed, stacked and normalised
_FIELD_COPIES = 3  # of PSFs over the field: by their defocus, as a bank, and with their light
_TILE = 4  # side of the tiles' transforms over that of the PSFs: with smaller tiles their overlap is most of them
_POINTS = 100  # bytes for each pixel along a PSF's side and each mask pixel: the matrices of the propagation
_MOST_COPIES = 64  # of PSFs: while they are computed, and in their spectra, for each state
_BANKS = 3  # held at a time by scatter and occlusion through wide blur: of layers, and their spectra


@dataclass(frozen=True, eq=False)
class Piece:
    """The PSFs of a part of a capture.

    Args:
        bank: computes the PSFs, or finds them in a memory; a :class:`~kornia_tidy.psf.field_bank.FieldBank` where there
            is a field.
        share: of the exposure; (S,) where the bank holds the PSFs of S states, those of a state after each other.
        span: the piece has the pixels with a defocus from the first to below the second, in radians; None: all.
        grid: sensor pixels along a side of a pixel of the PSFs.
        window: side in sensor pixels that holds the PSFs of all pieces, where they differ: a border ``"valid"`` crops
            by it.
        field: where over the picture its PSFs are known; None for PSFs that are the same everywhere.
        keep: False for PSFs that are made for each use, and once more in the backward pass.
    """

    bank: Callable[[], PSFBank | FieldBank]
    share: Tensor | float = 1.0
    span: tuple[float, float] | None = None
    grid: int = 1
    window: int | None = None
    field: Field | None = None
    keep: bool = True

    def holds(self, defocus: Tensor) -> Tensor:
        """Return which pixels of a defocus map are the piece's."""
        first, last = (-inf, inf) if self.span is None else self.span
        own = defocus.detach().double()  # as layers are assigned
        return (own >= first) & (own < last)


def pieces_of(
    model: PSFModel,
    channels: int,
    dtype: torch.dtype,
    reach: Tensor,
    compositing: str = "gather",
    budget: int | None = None,
    scene: Tensor | None = None,
    device: torch.device | None = None,
    field: Field | None = None,
) -> Iterator[Piece]:
    """Yield the pieces that add up to a capture: one piece in the ordinary case.

    Args:
        model: at one moment.
        channels: of the image: those of the spectrum, or 1.
        dtype: float32 or float64.
        reach: lowest and highest defocus of the scene in radians, (2,), or its map.
        compositing: ``"gather"``, ``"scatter"`` or ``"occlusion"``.
        budget: bytes for PSFs and images together. Half of it is for PSFs, their computation and their spectra, but at
            least :data:`LEAST_BYTES`. Default: all PSFs at once. PSFs that were measured or are interpolated over
            defocus come as a whole in any case, and so do all on accelerators and in compiled code.
        scene: the map, where it is at hand: of depths between that it does not hold, some are left out.
        device: of measured PSFs. Default: that of ``reach``.
        field: of the picture, behind a real lens.

    Raises:
        ValueError: if blur is so wide that scatter or occlusion would need more than the budget.

    Example:
        >>> [piece] = pieces_of(PSFModel(fidelity="draft"), 3, torch.float32, torch.tensor([-4.0, 5.0]))
        >>> piece.bank().psfs.shape[:2], piece.span
        (torch.Size([6, 3]), None)
    """
    scene, mode = reach if scene is None else scene, torch_mode()
    layering = None if Mode.GRAPH in mode or model.measured is not None else model.layering
    if (blur := layering and layering.blur) is not None:
        if compositing == "gather" and scene.numel():
            yield from _wide_pieces(model, blur, channels, dtype, scene)
            return
        _check_wide_bytes(blur, channels, dtype, compositing, budget)
    most, remembered = None, True
    points = 1 if field is None else len(field.points)
    if layering is not None and blur is None and budget is not None and not mode:
        side = max(model.fidelity.window or model.fidelity.max_window, layering.side)
        if _MOST_COPIES * channels * dtype.itemsize * len(layering.nodes) * side**2 * points > budget // 2:
            most, remembered = _most_layers(model, channels, dtype, reach, compositing, budget, points)
    source = model if remembered else model.without_memory()
    given: dict[str, Any] = {"channels": channels, "dtype": dtype, "device": device or reach.device, "field": field}
    make: Callable[..., Any] = partial(PSFModel.scene_bank, **given)
    if compositing == "occlusion" and (blur is not None or model.measured_cut):  # discs of rays end
        make = partial(_with_tails, make)
    if compositing == "occlusion" and model.measured is None and model.fidelity.occlusion_states == "each":
        shares = model.state_weights(dtype)
        if Mode.UNREAD in mode and model.lens is None:  # all states in one bank, for one rendering
            yield Piece(partial(make, source, defocus=reach, each_state=True), shares)
            return
        for state, share in enumerate(shares):
            one = partial(make, source.of_state(state), defocus=reach)
            yield Piece(one, share, field=field, keep=most is None)
    elif most is None:
        yield Piece(partial(make, source, defocus=reach), field=field)
    else:
        nodes = model.defocus_nodes
        for first, last in runs_of(present_intervals(nodes, scene), most - 1):
            own = partial(make, source, defocus=torch.tensor([nodes[first], nodes[last]], dtype=torch.float64))
            span = -inf if first == 0 else nodes[first], inf if last == len(nodes) - 1 else nodes[last]
            yield Piece(own, span=span, field=field, keep=False)


def render_piece(light: Tensor, defocus: Tensor, piece: Piece, rendering: Rendering) -> Tensor:
    """Return a piece's share of the irradiance, (B, C, h, w): zero where neither its pixels are nor their light falls.

    Args:
        light: (B, C, H, W) linear light.
        defocus: (B, 1, H, W) or (1, 1, H, W) radians.
        piece: PSFs. Gradients compute the others again.
        rendering: how.

    Example:
        >>> light, defocus = torch.ones(1, 3, 32, 32), torch.zeros(1, 1, 32, 32)
        >>> [piece] = pieces_of(PSFModel(fidelity="draft"), 3, light.dtype, defocus)
        >>> render_piece(light, defocus, piece, Rendering("gather", "reflect")).detach().mean().round()
        tensor(1.)
    """
    if not piece.keep and torch.is_grad_enabled():
        given = light, defocus, replace(piece, keep=True), rendering
        return cast("Tensor", checkpoint(render_piece, *given, use_reentrant=False, preserve_rng_state=False))
    if piece.window is not None:
        margin = 0  # other borders are continued as far as it takes
        if rendering.border == "valid":
            check_border("valid", *light.shape[-2:], piece.window)
            margin = piece.window // 2
        return gather_group(light, defocus, piece.bank(), piece.holds(defocus), piece.grid, margin, rendering.border)
    bank = piece.bank()
    margin = bank.window // 2 if rendering.border == "valid" else 0
    if len(light) == 0:  # gradients are zero
        return cropped(light, margin) + 0 * (defocus.sum() + bank.psfs.sum())
    inside, gathers = None, rendering.compositing == "gather"
    if piece.span is not None:
        inside = piece.holds(defocus)
        defocus = torch.where(inside, defocus, bank.defocus[0].to(defocus))  # an existing layer costs least
        light = light if gathers else light * inside
    planes = bank.psfs.shape[-3] // light.shape[1]  # of the scene's colours, where these have spectra, or of states
    if planes > 1:
        light = light.repeat(1, planes, 1, 1)
    if piece.field is not None and isinstance(bank, FieldBank):
        seen = render_over_field(light, defocus, bank, piece.field, rendering)
    else:
        seen = render_layers(light, defocus, bank.defocus, bank.psfs, bank.veil, rendering)
    if inside is not None and gathers:
        seen = torch.where(cropped(inside, margin), seen, 0)
    if isinstance(piece.share, Tensor) and piece.share.ndim:
        return (seen.unflatten(1, (len(piece.share), -1)) * piece.share.to(seen)[:, None, None, None]).sum(1)
    if planes > 1:
        seen = seen.unflatten(1, (-1, planes)).sum(2)
    return seen if isinstance(piece.share, float) and piece.share == 1 else seen * piece.share


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


def runs_of(present: list[bool], most: int) -> list[tuple[int, int]]:
    """Return begin and end of runs of consecutive present entries, of at most so many.

    Example:
        >>> runs_of([True, True, True, False, True], 2)
        [(0, 2), (2, 3), (4, 5)]
    """
    edges = [i for i, (before, own) in enumerate(pairwise([False, *present, False])) if before != own]
    runs = zip(edges[::2], edges[1::2], strict=True)
    return [(start, min(start + most, stop)) for first, stop in runs for start in range(first, stop, most)]


def _most_layers(
    model: PSFModel, channels: int, dtype: torch.dtype, reach: Tensor, compositing: str, budget: int, points: int
) -> tuple[int | None, bool]:
    """Return the most layers of a piece, None where all fit at once, and whether PSFs are remembered."""
    whole, fidelity = (None, True), model.fidelity
    layers = len(nodes_around(model.defocus_nodes, reach))
    if not reach.numel() or fidelity.layers not in ("nearest", "linear") or layers < 3:
        return whole
    psfs, work = layer_bytes(model, channels, dtype)
    psfs = psfs if points == 1 else psfs * points * _FIELD_COPIES // _COPIES
    allowed = max(budget // 2, LEAST_BYTES)
    if compositing == "occlusion":
        states = len(model.state_weights(dtype)) if fidelity.occlusion_states == "each" else 1
        return whole if states == 1 or states * layers * psfs <= allowed else (layers, False)
    if layers * (psfs + work) <= allowed:
        return whole
    return max(2, allowed // (psfs + work)), 2 * layers * psfs <= allowed  # memory that grows is copied


def _with_tails(make: Callable[..., Any], *given: Any, **options: Any) -> PSFBank:
    return make(*given, **options).with_tails()


def _wide_pieces(model: PSFModel, blur: WideBlur, channels: int, dtype: torch.dtype, scene: Tensor) -> Iterator[Piece]:
    held = held_nodes(blur, scene)
    ends = [-inf, *(group.nodes[-1] for group, _ in held[:-1]), inf]
    for (group, nodes), span in zip(held, pairwise(ends), strict=True):
        yield Piece(partial(model.group_bank, channels, dtype, group, nodes), 1.0, span, group.grid, blur.window)


def _check_wide_bytes(blur: WideBlur, channels: int, dtype: torch.dtype, compositing: str, budget: int | None) -> None:
    needed = _BANKS * len(blur.nodes) * channels * dtype.itemsize * blur.window**2
    if budget is not None and needed > budget:
        raise ValueError(
            f"compositing {compositing!r} of this lens needs {len(blur.nodes)} layers of PSFs {blur.window} px wide, "
            f"some {needed / 2**30:.1f} GiB, of which memory_budget allows {budget / 2**30:.1f} GiB: take "
            f"compositing='gather', a smaller aperture, a narrower depth_range, or a larger memory_budget"
        )
