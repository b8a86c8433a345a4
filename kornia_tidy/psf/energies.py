r"""The energy that many waves bring to the sensor's pixels: the costly part of the PSFs of a bank.

.. math:: E_d(p) = \sum_k w_k \sum_{u \in p} \left| K_d U_k K_d^T \right|^2_u

Two ways give it. :func:`wave_energies` forms each wave. :func:`mutual_energies` does not: a row of pixels sees waves
:math:`v = K U_k` over the pupil's columns, one for each state and each point of the row, and their energy in a pixel of
the row is a quadratic form that all of them share:

.. math:: \sum_{v} w_v \Big| \sum_n K_{un} v_n \Big|^2 = \sum_{nm} J_{nm} B_{nm}, \qquad
    J_{nm} = \sum_v w_v v_n v_m^*, \quad B_{nm} = K_{un} K_{um}^*

J is the mutual intensity of the light in the row, B belongs to a pixel and adds up over its points. So nothing grows
with states times points of both axes. Both are Hermitian and are kept as one real matrix, the sum of real and imaginary
part: that is symmetric plus antisymmetric, and those two are orthogonal. In C the same sums are made row by row.

Complex products are real ones throughout: :math:`a b` is the product of the row :math:`(\Re a, \Im a)`, which is how
memory holds :math:`a`, with two columns, which hold :math:`\bar b` and :math:`-i \bar b`. Waves and mutual intensities
live one block at a time, near a core; the backward pass makes each block again.

Source: Goodman, Statistical Optics, 5.2, for the mutual intensity.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, cast

import torch
from torch import Tensor
from torch.nn.functional import pad

from kornia_tidy.kernels.build import REALS, compiled
from kornia_tidy.kernels.mutual_intensity_ops import SOURCE, mutual_intensity_energies
from kornia_tidy.mode import Mode, torch_mode

# px, in C: .6 (23 px) to .85 (61 px) of the time of matrix products, beyond 100 px more than they
LARGEST_WINDOW = 65
# The mutual intensity in C takes as long as matrix products of this share of its operations: masks of 23 to 69 pixels,
# one and three of them, took 0.3 to 0.95 of the waves' time at 0.5 to 2.45 times their operations, 1.5 at 3.3 times.
GAIN_IN_C = 2.5
_BLOCK_SAMPLES = 2**18  # numbers of the waves held at once: a megabyte in float32 stays in a core's cache
_BLOCK_NUMBERS = 2**20  # of waves and mutual intensities held at once, if a single depth allows it


def pixel_energies(field: Tensor, weights: Tensor, kernels: Tensor) -> Tensor:
    r"""Return the light that falls on each pixel, averaged over the states of the modulator.

    .. math:: h_d(p) = \sum_k w_k \int_p \left| \mathcal{F}\{ U_k e^{i\psi_d\rho^2} \}(u) \right|^2 du

    Args:
        field: pupil fields U, one for each state, without defocus.
        weights: share of the exposure of each state.
        kernels: from :func:`~kornia_tidy.psf.propagation.sensor_kernels`.

    Returns:
        Energies in units of the squared amplitude times pupil radii squared, (D, P, P), real. Twice differentiable in
        all three.

    Shape:
        - field (K, N, N) complex, weights (K,), kernels (D, P, q, N) complex.

    Convention:
        - Axes are (y, x); a phase that rises along +x moves the light towards larger column indices.

    Example:
        >>> from kornia_tidy.psf.propagation import sensor_kernels
        >>> field = torch.ones(1, 8, 8, dtype=torch.complex128)
        >>> kernels = sensor_kernels([0.0], 0.25, 65, 8, 0.25, 1.0, 1e-9)
        >>> light = pixel_energies(field, torch.ones(1), kernels)
        >>> round(float(light.sum() / 4), 2)  # a square pupil of 2x2 radii lets through 4
        0.99
    """
    by_waves, by_intensity = energy_operations(len(weights), *kernels.shape[1:])
    gain = GAIN_IN_C if goes_in_c(field, weights, kernels) else 1
    energies = mutual_energies if by_intensity < gain * by_waves else wave_energies
    return energies(field, weights, kernels)


def energy_operations(states: int, window: int, order: int, cells: int) -> tuple[int, int]:
    r"""Return the additions and multiplications for a depth, wave by wave and by the mutual intensity.

    .. math:: K (8 U N^2 + 8 U^2 N + 4 U^2) \quad\text{and}\quad 4 (5 K + 1) U N^2 + 2 P^2 N^2, \qquad U = q P

    for K states, N cells of the pupil and q points a pixel along each side of a window P. The second way has little to
    do for each state and point more, and the first for each cell.

    Example:
        >>> energy_operations(5, 61, 3, 23), energy_operations(1, 61, 3, 92)
        ((35351940, 14004746), (37173156, 100162976))
    """
    points = order * window
    by_waves = states * (8 * points * cells**2 + 8 * points**2 * cells + 4 * points**2)
    return by_waves, (4 * (5 * states + 1) * points + 2 * window**2) * cells**2


# ---------------------------------------------------------------------- by waves


def wave_energies(field: Tensor, weights: Tensor, kernels: Tensor) -> Tensor:
    r"""Return :math:`\sum_{k,q,q'} w_k |K_d U_k K_d^T|^2`, summed over the q points of a pixel on each axis.

    Args:
        field: U, (K, N, N) complex.
        weights: (K,).
        kernels: (D, P, q, N) complex, of the field's precision.

    Returns:
        (D, P, P), real.

    Example:
        >>> wave_energies(torch.full((1, 2, 2), 1j), torch.ones(1), torch.ones(1, 1, 1, 2) + 0j)
        tensor([[[16.]]])
    """
    depths, window, order, _ = kernels.shape
    left = torch.view_as_real(kernels.resolve_conj()).flatten(-2)  # (D, P, q, 2N)
    first = _real_matrix(field.conj_physical().transpose(0, 1)).flatten(0, 1).flatten(1)  # (2N, K 2N)
    second = _real_matrix(kernels.transpose(1, 2)).flatten(1, 3).flatten(2)  # (D, 2 q P, 2N)
    rows = weights.to(left.dtype).repeat(order)
    energies = [
        _in_block(_energies_of_rows, first, rows, left[depth, row], second[depth])
        for depth, row in wave_blocks(len(weights), left.shape)
    ]
    return torch.cat(energies).view(depths, window, 2 * order, window).sum(2)


def _real_matrix(numbers: Tensor) -> Tensor:
    return torch.view_as_real(torch.stack((numbers, -1j * numbers), dim=1))


def _energies_of_rows(first: Tensor, rows: Tensor, left: Tensor, second: Tensor) -> Tensor:
    """Return (depth and pixel row, 2 q P) of left (depth, row, q, 2N); rows are the weights by point and state."""
    half = (left.reshape(-1, left.shape[-1]) @ first).view(len(left), -1, left.shape[-1])  # conj(K U)
    wave = torch.bmm(half, second.mT)  # (depth, rows and points and states, 2 q P)
    squares = wave.square() if wave.requires_grad or torch_mode() & Mode.TRACED else wave.square_()
    return torch.matmul(rows, squares.view(-1, len(rows), wave.shape[-1]))


def wave_blocks(states: int, shape: Sequence[int]) -> Iterator[tuple[slice, slice]]:
    """Yield slices of depths and of pixel rows, in order: as many as :data:`_BLOCK_SAMPLES` allows, or one row.

    Args:
        states: K.
        shape: (D, P, q, 2N).
    """
    depths, window, order, _ = shape
    row = order * states * 2 * window * order
    height = min(window, max(1, _BLOCK_SAMPLES // row))
    together = max(1, _BLOCK_SAMPLES // (row * window)) if height == window else 1
    for depth in range(0, depths, together):
        for top in range(0, window, height):
            yield slice(depth, depth + together), slice(top, top + height)


# ---------------------------------------------------------------------- by the mutual intensity


def mutual_energies(field: Tensor, weights: Tensor, kernels: Tensor) -> Tensor:
    r"""Return :math:`\sum_{k,q,q'} w_k |K_d U_k K_d^T|^2`, summed over the q points of a pixel on each axis.

    In C where there is a compiler, unless the window is large, or weights or kernels require gradients.

    Args:
        field: U, (K, N, N) complex.
        weights: (K,).
        kernels: (D, P, q, N) complex, of the field's precision.

    Returns:
        (D, P, P), real.

    Example:
        >>> mutual_energies(torch.full((1, 2, 2), 1j), torch.ones(1), torch.ones(1, 1, 1, 2) + 0j)
        tensor([[[16.]]])
    """
    weights = weights.to(field.real.dtype)
    if goes_in_c(field, weights, kernels):
        return mutual_intensity_energies(field, weights, kernels)
    window, order, cells = kernels.shape[1:]
    numbers = window * (4 * order * len(field) * cells + cells**2)
    parts = kernels.split(max(1, _BLOCK_NUMBERS // numbers))
    return torch.cat([_in_block(_energies_of_depths, field, weights, part) for part in parts])


def goes_in_c(field: Tensor, weights: Tensor, kernels: Tensor) -> bool:
    """Whether :func:`mutual_energies` are computed in C."""
    constant = not (torch.is_grad_enabled() and (weights.requires_grad or kernels.requires_grad))
    if not constant or field.device.type != "cpu" or torch_mode() & Mode.TRACED:
        return False
    dtype = field.dtype.to_real()
    return kernels.shape[1] <= LARGEST_WINDOW and dtype in REALS and compiled(SOURCE, dtype) is not None


def _energies_of_depths(field: Tensor, weights: Tensor, kernels: Tensor) -> Tensor:
    return intensity_energies(field[None], weights, *energy_matrices([kernels]))[:, 0]


def energy_matrices(kernels: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Return the two matrices of each depth and wavelength that do not depend on the masks.

    Wavelengths have different numbers of points a pixel; kernels are filled up with zeros, which add nothing.

    Args:
        kernels: for each wavelength (D, P, q, N) complex, from :func:`kornia_tidy.psf.propagation.sensor_kernels`.

    Returns:
        Kernels as real rows, (D, W, P, q, 2N), and products of each pixel's kernels, (D, W, P, N N).

    Example:
        >>> left, pixels = energy_matrices([torch.ones(3, 5, 1, 4) + 0j, torch.ones(3, 5, 2, 4) + 0j])
        >>> left.shape, pixels.shape
        (torch.Size([3, 2, 5, 2, 8]), torch.Size([3, 2, 5, 16]))
    """
    order = max(own.shape[2] for own in kernels)
    filled = torch.stack([pad(own, (0, 0, 0, order - own.shape[2])) for own in kernels], 1)
    left = torch.view_as_real(filled.resolve_conj()).flatten(-2)
    # B is packed as real less imaginary part: with J's sum of both, that leaves the real part of their product.
    return left, (_real_rows(filled).mT @ _real_rows(filled * (1 - 1j))).flatten(-2)


def intensity_energies(field: Tensor, weights: Tensor, left: Tensor, pixels: Tensor) -> Tensor:
    r"""Return :math:`\sum_{k,q,q'} w_k |K_{dw} U_{kw} K_{dw}^T|^2` of depths and wavelengths, without loops.

    Args:
        field: U, (W, K, N, N) complex.
        weights: (K,).
        left: (D, W, P, q, 2N) real, from :func:`energy_matrices`.
        pixels: (D, W, P, N N) real, from there.

    Returns:
        (D, W, P, P), real, summed over the q points of a pixel on each axis.

    Example:
        >>> matrices = energy_matrices([torch.ones(1, 1, 1, 2) + 0j])
        >>> intensity_energies(torch.full((1, 1, 2, 2), 1j), torch.ones(1), *matrices)
        tensor([[[[16.]]]])
    """
    plain = _columns(field)
    turned = _columns(field * (weights * (1 + 1j))[:, None, None])
    flat, shape = left.flatten(2, 3), (*left.shape[:3], -1, field.shape[-1])  # (D, W, P q, 2N)
    intensity = (flat @ plain).view(shape).mT @ (flat @ turned).view(shape)  # (D, W, P, N, N)
    return (intensity.flatten(-2) @ pixels.mT).clamp(min=0)  # no light: rounding leaves less than zero


def _columns(field: Tensor) -> Tensor:
    """Return the real matrices (W, 2N, K 2N) that take (re, im) of a kernel's cells to those of K U."""
    return _real_rows(torch.stack((field, 1j * field), 2).permute(0, 3, 2, 1, 4)).flatten(3).flatten(1, 2)


def _real_rows(numbers: Tensor) -> Tensor:
    """Return (..., R, N) complex as (..., 2R, N): rows of real and of imaginary parts by turns."""
    return torch.view_as_real(numbers.resolve_conj()).movedim(-1, -2).flatten(-3, -2)


def _in_block(energies: Callable[..., Tensor], *given: Tensor) -> Tensor:
    """Return the energies of a block; the backward pass keeps only the inputs."""
    with torch.autocast(given[0].device.type, enabled=False):
        return energies(*given) if torch_mode() & Mode.TRACED else made_again(energies, None, *given)


def made_again(function: Callable[..., Tensor], known: Tensor | None, *given: Tensor) -> Tensor:
    """Return a function's values; the backward pass computes it again. Where they are known, only that does."""
    return cast("Tensor", _MadeAgain.apply(function, known, *given))


class _MadeAgain(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, function: Callable[..., Tensor], known: Tensor | None, *given: Tensor) -> Tensor:
        ctx.function = function
        ctx.save_for_backward(*given)
        return function(*given) if known is None else known.clone()

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        wanted, twice = ctx.needs_input_grad[2:], torch.is_grad_enabled()
        with torch.enable_grad(), torch.autocast(gradients[0].device.type, enabled=False):
            given = zip(ctx.saved_tensors, wanted, strict=True)
            own = [x.view_as(x) if twice else x.detach().requires_grad_(want) for x, want in given]
            asked = [x for x, want in zip(own, wanted, strict=True) if want]
            found = iter(torch.autograd.grad(ctx.function(*own), asked, gradients, create_graph=twice))
        return None, None, *(next(found) if want else None for want in wanted)
