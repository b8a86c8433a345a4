r"""The PSFs of all depths, wavelengths and states at once, by the mutual intensity in the pupil, for accelerators.

The same sums as in :mod:`kornia_tidy.psf.mutual_intensity`, without loops: an accelerator takes as long to be told of
a product as to make it. Wavelengths have different numbers of points a pixel; kernels are filled up with zeros, which
adds nothing to the sums.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from kornia_tidy.psf.mutual_intensity import real_rows


def energy_matrices(kernels: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Return the two matrices of each depth and wavelength that do not depend on the masks.

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
    filled = torch.stack([torch.nn.functional.pad(own, (0, 0, 0, order - own.shape[2])) for own in kernels], 1)
    left = torch.view_as_real(filled.resolve_conj()).flatten(-2)
    pixels = (real_rows(filled).mT @ real_rows(filled * (1 - 1j))).flatten(-2)
    return left, pixels


def batched_energies(field: Tensor, weights: Tensor, left: Tensor, pixels: Tensor) -> Tensor:
    r"""Return :math:`\sum_{k,q,q'} w_k |K_{dw} U_{kw} K_{dw}^T|^2`, summed over the q points of a pixel on each axis.

    Args:
        field: U, (W, K, N, N) complex.
        weights: (K,).
        left: (D, W, P, q, 2N) real, from :func:`energy_matrices`.
        pixels: (D, W, P, N N) real, from there.

    Returns:
        (D, W, P, P), real.

    Example:
        >>> matrices = energy_matrices([torch.ones(1, 1, 1, 2) + 0j])
        >>> batched_energies(torch.full((1, 1, 2, 2), 1j), torch.ones(1), *matrices)
        tensor([[[[16.]]]])
    """
    depths, wavelengths, window = left.shape[:3]
    cells = field.shape[-1]
    plain = _columns(field)
    turned = _columns(field * (weights * (1 + 1j))[:, None, None])
    flat = left.flatten(2, 3)  # (D, W, P q, 2N)
    shape = (depths, wavelengths, window, -1, cells)
    intensity = (flat @ plain).view(shape).mT @ (flat @ turned).view(shape)
    return (intensity.flatten(-2) @ pixels.mT).clamp(min=0)  # where there is no light, rounding leaves less than none


def _columns(field: Tensor) -> Tensor:
    """Return the real matrices (W, 2N, K 2N) that take (re, im) of a kernel's cells to those of K U."""
    rotated = torch.stack((field, 1j * field), 2)  # (W, K, 2, N, N)
    return real_rows(rotated.permute(0, 3, 2, 1, 4)).flatten(3).flatten(1, 2)
