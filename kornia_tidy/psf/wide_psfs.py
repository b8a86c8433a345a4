"""PSFs of wide blur: exact near focus, geometric for large discs, on the grid of each group of layers."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from kornia_tidy.psf.energies import made_again
from kornia_tidy.psf.geometric_psf import blur_radius, geometric_psfs
from kornia_tidy.psf.psf_bank import PSFBank
from kornia_tidy.psf.psf_cache import present_intervals
from kornia_tidy.psf.pupil import Pupil
from kornia_tidy.psf.wide_blur import BlurGroup, WideBlur

Exact = Callable[[Tensor, Tensor, tuple[float, ...], int], PSFBank]
"""Exact PSFs of states and their weights, at nodes, in a window."""
MOST_LEARNT = 257  # sensor pixels; waves cost the square of a window's side


def wide_psfs(
    exact: Callable[[tuple[float, ...], int], PSFBank],
    blur: WideBlur,
    pupil: Pupil,
    step: float,
    grid: int,
    channels: int,
    window: int,
    nodes: tuple[float, ...],
    like: Tensor,
) -> PSFBank:
    """Return PSFs on one grid: exact for small discs, geometric for large ones.

    Args:
        exact: makes PSFs at nodes, in a window.
        blur: says from which radius on PSFs are geometric.
        pupil: the aperture.
        step: a sensor pixel seen from the pupil in metres.
        grid: sensor pixels along a side of a pixel of the grid.
        channels: number of colour channels.
        window: side of the PSFs in pixels of the grid.
        nodes: defocus in radians, ascending.
        like: a tensor of the PSFs' type and device.
    """
    by_waves = torch.tensor([blur_radius(psi, step) < blur.ray_radius for psi in nodes], device=like.device)
    psfs, at = like.new_empty(len(nodes), channels, window, window), torch.tensor(nodes, dtype=torch.float64)
    small, large = (tuple(at[which.cpu()].tolist()) for which in (by_waves, ~by_waves))
    if small:
        psfs[by_waves] = exact(small, window).psfs
    if large:
        rays = geometric_psfs(pupil.transmission.to(like.device), pupil.cell_pitch, large, step * grid, window)
        psfs[~by_waves] = rays.to(like)[:, None]  # the same at all wavelengths
    return PSFBank(psfs, psfs.new_tensor(nodes), psfs.sum((2, 3)))


def held_nodes(blur: WideBlur, defocus: Tensor) -> list[tuple[BlurGroup, tuple[float, ...]]]:
    """Return the groups that hold pixels of a scene, and the nodes of each around those pixels.

    Args:
        blur: the lens.
        defocus: map in radians, or its lowest and highest value, (2,), between which everything counts.
    """
    present, found = present_intervals(blur.nodes, defocus), []
    for group in blur.groups:
        first = blur.nodes.index(group.nodes[0])
        own = [i for i in range(len(group.nodes) - 1) if present[first + i]]
        if own:
            found.append((group, tuple(group.nodes[i] for i in sorted({i + k for i in own for k in (0, 1)}))))
    return found


def learnt_bank(bank: PSFBank, exact: Exact, states: Tensor, weights: Tensor, grid: int) -> PSFBank:
    """Return a bank whose gradients reach the masks: those of the exact PSFs, computed in the backward pass.

    Args:
        bank: PSFs of these states, without gradients.
        exact: makes them by wave optics.
        states: phases, (S, N, N).
        weights: share of the exposure of each.
        grid: sensor pixels along a side of a pixel of the grid.

    Raises:
        RuntimeError: in the backward pass, if PSFs are wider than :data:`MOST_LEARNT`.
    """
    window = bank.window

    def depth(psi: float, states: Tensor, weights: Tensor) -> Tensor:
        if window * grid > MOST_LEARNT:
            raise RuntimeError(
                f"gradients of masks are computed through PSFs of at most {MOST_LEARNT} px, got {window * grid} px: "
                f"freeze the masks by masks.requires_grad_(False), or take a smaller aperture or a narrower depth_range"
            )
        return exact(states, weights, (psi,), window).psfs

    # One depth at a time: waves of large windows are large.
    depths = zip(bank.defocus.tolist(), bank.psfs.split(1), strict=True)
    psfs = torch.cat([made_again(partial(depth, psi), own, states, weights) for psi, own in depths])
    return PSFBank(psfs, bank.defocus, psfs.sum((2, 3)))


def is_flat(states: Tensor) -> bool:
    """Return whether all states show the same phase at every pixel, so that the lens is one without a mask.

    Example:
        >>> is_flat(torch.zeros(2, 4, 4)), is_flat(torch.rand(2, 4, 4))
        (True, False)
    """
    flat = states.detach().flatten(1)
    return bool((flat == flat[:, :1]).all())
