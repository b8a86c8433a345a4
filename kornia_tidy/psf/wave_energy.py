r"""The energy of many waves by products of real matrices: what the PSFs of a bank cost.

A complex product :math:`a b` is the real product of the row :math:`(\Re a, \Im a)`, which is how memory holds
:math:`a`, with two columns, which hold :math:`\bar b` and :math:`-i \bar b`. So fields and kernels become real
matrices once, all depths and all states share the first product, and nothing is rearranged between the two. The waves
live one cache-sized block at a time: only their energies are kept, and the backward pass makes each block again.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from kornia_tidy.psf.checkpointed_sum import recomputed
from kornia_tidy.psf.gradients_only import is_gradients_only

_BLOCK_SAMPLES = 2**18  # numbers of the waves held at once: a megabyte in float32 stays in a core's cache


def wave_energies(field: Tensor, weights: Tensor, kernels: Tensor) -> Tensor:
    r"""Return :math:`\sum_{k,q,q'} w_k |K_d U_k K_d^T|^2`, summed over the q points of a pixel on each axis.

    Args:
        field: U, (K, N, N) complex.
        weights: (K,).
        kernels: (D, P, q, N) complex, of the field's precision.

    Returns:
        (D, P, P), real. Twice differentiable in all three.

    Example:
        >>> wave_energies(torch.full((1, 2, 2), 1j), torch.ones(1), torch.ones(1, 1, 1, 2) + 0j)
        tensor([[[16.]]])
    """
    weights = weights.to(field.real.dtype)
    left = torch.view_as_real(kernels).flatten(-2)
    first = _real_matrix(field.conj_physical().transpose(0, 1))  # (N, 2, K, N, re-im)
    second = _real_matrix(kernels.transpose(1, 2))  # (D, 2, q, P, N, re-im)
    matrices = first.flatten(0, 1).flatten(1), weights, left, second.flatten(1, 3).flatten(2)
    return recomputed(_energies, _gradients, *matrices)


def _real_matrix(numbers: Tensor) -> Tensor:
    return torch.view_as_real(torch.stack((numbers, -1j * numbers), dim=1))


def _energies(first: Tensor, weights: Tensor, left: Tensor, second: Tensor) -> Tensor:
    """Energies (D, P, P) of first (2N, K 2N), weights (K,), left (D, P, q, 2N) and second (D, 2 q P, 2N)."""
    depths, window, order, _ = left.shape
    if is_gradients_only():
        return left.new_zeros(depths, window, window)
    rows = weights.repeat(order)
    energies = []
    with torch.autocast(left.device.type, enabled=False):
        for depth, row in _blocks(len(weights), left.shape):
            _, wave = _waves(first, left[depth, row], second[depth])
            squares = wave.square() if wave.requires_grad else wave.square_()
            lines = torch.matmul(rows, squares.view(-1, len(rows), wave.shape[-1]))
            energies.append(lines.view(-1, 2 * order, window).sum(1))
    return torch.cat(energies).view(depths, window, window)


def _gradients(
    first: Tensor, weights: Tensor, left: Tensor, second: Tensor, gradient: Tensor, needed: Sequence[bool]
) -> tuple[Tensor | None, ...]:
    """Return the gradients of the four inputs, of those needed; a sum over blocks, like the energies."""
    depths, _, order, cells = left.shape
    states = len(weights)
    rows = weights.repeat(order)[:, None]
    to_first, to_weights = torch.zeros_like(first), torch.zeros_like(weights)
    to_left: list[Tensor] = []
    to_second: list[Tensor] = [torch.zeros_like(s) for s in second] if needed[3] else []
    for depth, row in _blocks(states, left.shape):
        block, later = left[depth, row], second[depth]
        half, wave = _waves(first, block, later)
        light = gradient[depth, row].repeat(1, 1, 2 * order).flatten(0, 1)[:, None]
        lines = wave.view(len(light), -1, wave.shape[-1]) * light  # (depth and pixel row), (q and state), sample
        if needed[1]:
            squares = torch.einsum("rks,rks->k", lines, wave.view(lines.shape))
            to_weights = to_weights + squares.view(order, states).sum(0)
        lines = lines.view(wave.shape)
        to_half = torch.bmm(lines, later)  # but for the states' weights and a 2, which come last
        if needed[0]:
            to_first = to_first + block.reshape(-1, cells).mT @ to_half.view(-1, states * cells)
        if needed[2]:
            weighted = to_half.view(-1, order * states, cells) * (2 * rows)
            to_left.append(weighted.view(-1, states * cells) @ first.mT)
        if needed[3]:
            weighted = half.view(-1, order * states, cells) * (2 * rows)
            products = torch.bmm(lines.mT, weighted.view(half.shape))
            for d, product in zip(range(depths)[depth], products, strict=True):
                to_second[d] = to_second[d] + product
    by_state = (2 * weights).repeat_interleave(cells)
    return (
        to_first * by_state if needed[0] else None,
        to_weights if needed[1] else None,
        torch.cat(to_left).view(left.shape) if needed[2] else None,
        torch.stack(to_second) if needed[3] else None,
    )


def _waves(first: Tensor, left: Tensor, second: Tensor) -> tuple[Tensor, Tensor]:
    """Return conj(K U), (depth, rows, 2N), and the wave, (depth, rows, 2 q P), rows being pixel, point and state."""
    half = (left.reshape(-1, left.shape[-1]) @ first).view(len(left), -1, left.shape[-1])
    return half, torch.bmm(half, second.mT)


def _blocks(states: int, shape: Sequence[int]) -> Iterator[tuple[slice, slice]]:
    """Yield slices of depths and of pixel rows, in order: as many as _BLOCK_SAMPLES samples allow, or one row."""
    depths, window, order, _ = shape
    row = order * states * 2 * window * order
    height = min(window, max(1, _BLOCK_SAMPLES // row))
    together = max(1, _BLOCK_SAMPLES // (row * window)) if height == window else 1
    for depth in range(0, depths, together):
        for top in range(0, window, height):
            yield slice(depth, depth + together), slice(top, top + height)
