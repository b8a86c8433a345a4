"""Inverse kernels: Tikhonov deconvolution as a convolution with kernels of bounded size."""

from __future__ import annotations

import torch
from torch import Tensor

from kornia_tidy.checks import check_float_tensor, check_positive
from kornia_tidy.render.borders import next_fast_size

MARGIN = 8  # px on each side of a kernel beyond the PSF


def tikhonov_kernels(psf: Tensor, weights: tuple[float, ...]) -> Tensor:
    r"""Return the kernels of Tikhonov deconvolution with the capture as prior, truncated to a window.

    .. math:: k = \mathcal{F}^{-1} \left[ \frac{\bar{H} + \gamma / e}{|H|^2 + \gamma} \right]

    with the energy e of the PSF. Convolution with them is :func:`~kornia_tidy.reconstruction.tikhonov.tikhonov` with
    the capture over e as prior, up to the truncation. Truncation bounds the receptive field, so that a picture can be
    reconstructed in tiles. A constant is added to each kernel so that its sum is 1/e: white becomes white.

    Args:
        psf: (C, P, P) with P odd, and a positive sum.
        weights: :math:`\gamma` of each kernel, in units of the square of a PSF's energy.

    Returns:
        (D, C, P + 16, P + 16) for D weights, in the dtype of ``psf``; gradients reach the PSF.

    Raises:
        TypeError: if the PSF is not floating point.
        ValueError: if it is of another shape, or a weight is not positive.

    Source: Sitzmann et al., ACM Transactions on Graphics 37(4) 114 (2018), for the closed form.

    Example:
        >>> point = torch.zeros(1, 3, 3)
        >>> point[0, 1, 1] = 0.5
        >>> kernel = tikhonov_kernels(point, (0.25,))
        >>> kernel.shape, round(kernel.sum().item(), 5)
        (torch.Size([1, 1, 19, 19]), 2.0)
    """
    window, size = window_and_plane("psf", psf, "(C, P, P)")
    for weight in weights:
        check_positive("weight", weight)
    transfer = torch.fft.rfft2(psf, s=(size, size))
    power = transfer.real.square() + transfer.imag.square()
    centred = torch.fft.rfft2(_point(psf), s=(size, size))  # of a PSF that is a point at its centre
    energy = psf.sum((-2, -1))[:, None, None]
    gammas = psf.new_tensor(weights)[:, None, None, None]
    inverse = torch.fft.irfft2((transfer.conj() + gammas * centred.conj() / energy) / (power + gammas), s=(size, size))
    return centred_window(inverse, window, psf.sum((-2, -1)))


def window_and_plane(name: str, psfs: Tensor, axes: str) -> tuple[int, int]:
    """Check PSFs, and return the sides of their kernels and of the plane on which these are computed."""
    check_float_tensor(name, psfs, axes.count(",") + 1, axes)
    side = psfs.shape[-1]
    if psfs.shape[-2] != side or side % 2 == 0:
        raise ValueError(f"{name} must have shape {axes} with P odd, got {tuple(psfs.shape)}")
    window = side + 2 * MARGIN
    return window, next_fast_size(4 * window)  # kernels decay slowly and must not wrap around


def centred_window(inverse: Tensor, window: int, energy: Tensor) -> Tensor:
    """Return the kernels in planes of inverse PSFs, with a constant added so that white becomes white.

    Args:
        inverse: (D, C, N, N); PSFs begin at the corner of the plane, so their inverses end there.
        window: side of the kernels in pixels, larger than that of the PSFs by twice ``MARGIN``.
        energy: of the PSFs, (C,), the reciprocal of the sum of a kernel.
    """
    kernels = inverse.roll((window - 1 - MARGIN, window - 1 - MARGIN), (-2, -1))[..., :window, :window]
    return kernels + (1 / energy[:, None, None] - kernels.sum((-2, -1), keepdim=True)) / window**2


def _point(psf: Tensor) -> Tensor:
    point = torch.zeros_like(psf[:1])
    point[..., psf.shape[-1] // 2, psf.shape[-1] // 2] = 1.0
    return point
