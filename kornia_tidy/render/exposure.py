"""The irradiance of an exposure: the sum over the pieces of its PSFs, each for its share of the time and its pixels."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from kornia_tidy.psf.field_bank import FieldBank
from kornia_tidy.psf.pieces import Piece
from kornia_tidy.render.borders import cropped
from kornia_tidy.render.coarse_gather import gather_group
from kornia_tidy.render.over_field import render_over_field
from kornia_tidy.render.render_ops import Rendering, render_layers


def render_pieces(light: Tensor, defocus: Tensor, pieces: Iterable[Piece], rendering: Rendering) -> Tensor:
    """Return the irradiance of a scene on the sensor, over the whole exposure.

    Args:
        light: (B, C, H, W) linear light.
        defocus: (B, 1, H, W) or (1, 1, H, W) radians.
        pieces: from :func:`kornia_tidy.psf.pieces.pieces_of`, at least one.
        rendering: how.

    Returns:
        (B, C, h, w), smaller than the light with the border ``"valid"``. Gradients make pieces whose PSFs are not kept
        once more.

    Example:
        >>> from kornia_tidy.psf import PSFModel
        >>> from kornia_tidy.psf.pieces import pieces_of
        >>> light, defocus = torch.ones(1, 3, 32, 32), torch.zeros(1, 1, 32, 32)
        >>> pieces = pieces_of(PSFModel(fidelity="draft"), 3, light.dtype, defocus)
        >>> render_pieces(light, defocus, pieces, Rendering("gather", "reflect")).detach().mean().round()
        tensor(1.)
    """
    total = None
    for piece in pieces:
        if piece.keep or not torch.is_grad_enabled():
            own = render_piece(light, defocus, piece, rendering)
        else:
            given = light, defocus, piece, rendering
            own = checkpoint(render_piece, *given, use_reentrant=False, preserve_rng_state=False)
        total = own if total is None else total + own
    if total is None:
        raise ValueError("a capture is a sum over at least one piece, got none")
    return total


def render_piece(light: Tensor, defocus: Tensor, piece: Piece, rendering: Rendering) -> Tensor:
    """Return a piece's share of the irradiance: zero where neither its pixels are nor their light falls.

    Args:
        light: (B, C, H, W) linear light.
        defocus: (B, 1, H, W) or (1, 1, H, W) radians.
        piece: PSFs.
        rendering: how.
    """
    if piece.window is not None:
        return gather_group(light, defocus, piece, rendering.border)
    bank = piece.bank()
    margin = bank.window // 2 if rendering.border == "valid" else 0
    if len(light) == 0:  # gradients are zero
        return cropped(light, margin) + 0 * (defocus.sum() + bank.psfs.sum())
    inside, gathers = None, rendering.compositing == "gather"
    if piece.span is not None:
        inside = piece.holds(defocus)
        defocus = torch.where(inside, defocus, bank.defocus[0].to(defocus))  # a layer that is there costs least
        light = light if gathers else light * inside
    planes = bank.psfs.shape[-3] // light.shape[1]  # of the scene's colours, where these have spectra, or of states
    if planes > 1:
        light = light.repeat(1, planes, 1, 1)
    if piece.field is not None and isinstance(bank, FieldBank):
        seen = render_over_field(light, defocus, bank, piece.field, rendering)
    else:
        seen = render_layers(light, defocus, bank.defocus, bank.psfs, bank.veil, **asdict(rendering))
    if inside is not None and gathers:
        seen = torch.where(cropped(inside, margin), seen, 0)
    if isinstance(piece.share, Tensor) and piece.share.ndim:
        return (seen.unflatten(1, (len(piece.share), -1)) * piece.share.to(seen)[:, None, None, None]).sum(1)
    if planes > 1:
        seen = seen.unflatten(1, (-1, planes)).sum(2)
    return seen if isinstance(piece.share, float) and piece.share == 1 else seen * piece.share
