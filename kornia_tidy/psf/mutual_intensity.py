r"""The energy of many waves by the mutual intensity in the pupil: what the PSFs of many states cost.

A row of pixels sees waves :math:`v = K U_k` over the pupil's columns, one for each state and each point of the row.
Their energy in a pixel of the row is a quadratic form that all of them share:

.. math:: \sum_{v} w_v \Big| \sum_n K_{un} v_n \Big|^2 = \sum_{nm} J_{nm} B_{nm}, \qquad
    J_{nm} = \sum_v w_v v_n v_m^*, \quad B_{nm} = K_{un} K_{um}^*

J is the mutual intensity of the light in the row, B belongs to a pixel and adds up over its points. So nothing grows
with states times points of both axes, and no wave on the sensor is ever formed. Both are Hermitian and are kept as one
real matrix, the sum of real and imaginary part: that is symmetric plus antisymmetric, and those two are orthogonal.

Source: Goodman, Statistical Optics, 5.2, for the mutual intensity.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import torch
from torch import Tensor

from kornia_tidy.kernels.build import REALS, compiled
from kornia_tidy.kernels.mutual_intensity_ops import SOURCE, mutual_field_gradient, mutual_intensity_energies
from kornia_tidy.psf.gradients_only import is_gradients_only
from kornia_tidy.runtime.tracing import is_transformed, recording_in_operator

LARGEST_WINDOW = (
    65  # px, in C: 0.6 (23 px) to 0.85 (61 px) of the time of matrix products, beyond 100 px more than they
)

torch.library.define("kornia_tidy::mutual_energies", "(Tensor field, Tensor weights, Tensor kernels) -> Tensor")
torch.library.define(
    "kornia_tidy::mutual_energies_gradients",
    "(Tensor field, Tensor weights, Tensor kernels, Tensor gradient, bool[] wanted) -> Tensor[]",
)

_BLOCK_NUMBERS = 2**20  # held at once, if a single depth allows it: they stay near a core


def mutual_energies(field: Tensor, weights: Tensor, kernels: Tensor) -> Tensor:
    r"""Return :math:`\sum_{k,q,q'} w_k |K_d U_k K_d^T|^2`, summed over the q points of a pixel on each axis.

    Args:
        field: U, (K, N, N) complex.
        weights: (K,).
        kernels: (D, P, q, N) complex, of the field's precision.

    Returns:
        (D, P, P), real. Twice differentiable in all three.

    Example:
        >>> mutual_energies(torch.full((1, 2, 2), 1j), torch.ones(1), torch.ones(1, 1, 1, 2) + 0j)
        tensor([[[16.]]])
    """
    weights = weights.to(field.real.dtype)
    if is_transformed():
        return _energies(*_matrices(field, weights, kernels))
    return torch.ops.kornia_tidy.mutual_energies(field, weights, kernels)


def goes_in_c(window: int, dtype: torch.dtype) -> bool:
    """Whether energies are had faster in C: where there is a compiler, unless the window is large.

    Args:
        window: side of the PSFs in pixels.
        dtype: of the energies.
    """
    return window <= LARGEST_WINDOW and dtype in REALS and compiled(SOURCE, dtype) is not None


def _choose_energies(field: Tensor, weights: Tensor, kernels: Tensor) -> Tensor:
    """Compute the energies by the C kernel where it is faster, and otherwise by matrix products in torch."""
    if is_gradients_only():
        return torch.zeros_like(_new_energies(field, weights, kernels))
    if field.device.type == "cpu" and goes_in_c(kernels.shape[1], weights.dtype):
        return mutual_intensity_energies(field, weights, kernels)
    return _energies(*_matrices(field, weights, kernels))


def _matrices(field: Tensor, weights: Tensor, kernels: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the real matrices that energies are products of: plain, flipped, left and pixels."""
    plain, turned = _columns(field), _columns(field * weights[:, None, None] * (1 + 1j))
    left = torch.view_as_real(kernels.resolve_conj()).flatten(-2)
    with torch.autocast(left.device.type, enabled=False):
        # B is packed as real less imaginary part: with J's sum of both, that leaves the real part of their product.
        pixels = (real_rows(kernels).mT @ real_rows(kernels * (1 - 1j))).flatten(-2)
    return plain, turned, left, pixels


def _columns(field: Tensor) -> Tensor:
    """Return the real matrix (2N, K 2N) that takes (re, im) of a kernel's cells to real and imaginary parts of K U."""
    return real_rows(torch.stack((field, 1j * field), 1).permute(2, 1, 0, 3)).flatten(2).flatten(0, 1)


def real_rows(numbers: Tensor) -> Tensor:
    """Return (..., R, N) complex as (..., 2R, N): rows of real and of imaginary parts by turns."""
    return torch.view_as_real(numbers).movedim(-1, -2).flatten(-3, -2)


def _energies(plain: Tensor, turned: Tensor, left: Tensor, pixels: Tensor) -> Tensor:
    """Energies (D, P, P) of plain and turned (2N, K 2N), left (D, P, q, 2N) and pixels (D, P, N N)."""
    with torch.autocast(left.device.type, enabled=False):
        lines = [
            _intensity(*_rows(plain, turned, left[depth])).flatten(-2) @ pixels[depth].mT
            for depth in _blocks(plain, left)
        ]
    return torch.cat(lines).clamp(min=0)  # where there is no light, rounding leaves less than none


def _gradients(
    plain: Tensor, turned: Tensor, left: Tensor, pixels: Tensor, gradient: Tensor, needed: Sequence[bool]
) -> tuple[Tensor | None, ...]:
    """Return the gradients of the four inputs, of those needed; a sum over blocks, like the energies."""
    to_plain, to_turned = torch.zeros_like(plain), torch.zeros_like(turned)
    to_left: list[Tensor] = []
    to_pixels: list[Tensor] = []
    for depth in _blocks(plain, left):
        block = left[depth]
        rows, others = _rows(plain, turned, block)
        to_intensity = (gradient[depth] @ pixels[depth]).unflatten(-1, (rows.shape[-1], -1))
        to_rows = (others @ to_intensity.mT).view(-1, plain.shape[-1])
        to_others = (rows @ to_intensity).view(-1, plain.shape[-1])
        if needed[0] or needed[1]:
            cells = block.reshape(-1, block.shape[-1]).mT
            to_plain, to_turned = to_plain + cells @ to_rows, to_turned + cells @ to_others
        if needed[2]:
            to_left.append((to_rows @ plain.mT + to_others @ turned.mT).view(block.shape))
        if needed[3]:
            to_pixels.append(gradient[depth].mT @ _intensity(rows, others).flatten(-2))
    return (
        to_plain if needed[0] else None,
        to_turned if needed[1] else None,
        torch.cat(to_left) if needed[2] else None,
        torch.cat(to_pixels) if needed[3] else None,
    )


def _rows(plain: Tensor, turned: Tensor, left: Tensor) -> tuple[Tensor, Tensor]:
    """Return the waves of each row of pixels, and these weighted and times 1 + i, (depth, P, q K 2, N) each."""
    depths, window, _, cells = left.shape
    flat, shape = left.reshape(-1, cells), (depths, window, -1, cells // 2)
    return (flat @ plain).view(shape), (flat @ turned).view(shape)


def _intensity(rows: Tensor, others: Tensor) -> Tensor:
    """Return the packed mutual intensity, (depth, P, N, N)."""
    return rows.mT @ others


def _blocks(plain: Tensor, left: Tensor) -> Iterator[slice]:
    """Yield slices of depths, in order: as many as _BLOCK_NUMBERS waves and mutual intensities allow, or one."""
    depths, window, order, cells = left.shape
    numbers = window * (2 * order * plain.shape[-1] + (cells // 2) ** 2)
    together = max(1, _BLOCK_NUMBERS // numbers)
    for depth in range(0, depths, together):
        yield slice(depth, depth + together)


# ---------------------------------------------------------------------- operators
# A compiler sees them as one node each: which of the ways is taken, and block by block, is decided when they run.


def _new_energies(field: Tensor, weights: Tensor, kernels: Tensor) -> Tensor:
    return weights.new_empty(kernels.shape[0], kernels.shape[1], kernels.shape[1])


def _make_gradients(
    field: Tensor, weights: Tensor, kernels: Tensor, gradient: Tensor, wanted: Sequence[bool]
) -> list[Tensor]:
    """Return the gradients that are wanted, without the energies: that of the field alone by the C kernel."""
    in_c = field.device.type == "cpu" and goes_in_c(kernels.shape[1], weights.dtype)
    if in_c and list(wanted) == [True, False, False]:
        return [mutual_field_gradient(field, weights, kernels, gradient)]
    inputs = [x.detach().requires_grad_(want) for x, want in zip((field, weights, kernels), wanted, strict=True)]
    with recording_in_operator():
        matrices = _matrices(*inputs)
        needed = [x.requires_grad for x in matrices]
        with torch.no_grad(), torch.autocast(gradient.device.type, enabled=False):
            found = _gradients(*matrices, gradient, needed)
        outputs, gradients = zip(*((x, g) for x, g in zip(matrices, found, strict=True) if g is not None), strict=True)
        leaves = [x for x in inputs if x.requires_grad]
        return [x.resolve_conj().contiguous() for x in torch.autograd.grad(outputs, leaves, gradients)]


def _new_gradients(
    field: Tensor,
    weights: Tensor,
    kernels: Tensor,
    gradient: Tensor,
    wanted: Sequence[bool],
) -> list[Tensor]:
    inputs = zip((field, weights, kernels), wanted, strict=True)
    return [x.new_empty(x.shape) for x, want in inputs if want]


def _keep(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    ctx.save_for_backward(*inputs)


def _backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
    inputs, wanted = ctx.saved_tensors, list(ctx.needs_input_grad[:3])
    if not torch.is_grad_enabled():
        found = iter(torch.ops.kornia_tidy.mutual_energies_gradients(*inputs, gradient, wanted))
    else:  # it is differentiated in turn
        own = [x.view_as(x) for x in inputs]
        energies = _energies(*_matrices(*own))
        asked = [x for x, want in zip(own, wanted, strict=True) if want]
        found = iter(torch.autograd.grad(energies, asked, gradient, create_graph=True))
    return tuple(next(found) if want else None for want in wanted)


torch.library.impl("kornia_tidy::mutual_energies", "default", _choose_energies)
torch.library.register_fake("kornia_tidy::mutual_energies", _new_energies)
torch.library.register_autograd("kornia_tidy::mutual_energies", _backward, setup_context=_keep)
torch.library.impl("kornia_tidy::mutual_energies_gradients", "default", _make_gradients)
torch.library.register_fake("kornia_tidy::mutual_energies_gradients", _new_gradients)
