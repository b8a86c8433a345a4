"""Inverse kernels: Wiener restoration by the statistics of scenes as a convolution with kernels of bounded size."""

from __future__ import annotations

import torch
from torch import Tensor

from kornia_tidy.checks import check_positive
from kornia_tidy.data.scene_statistics import PHOTOGRAPHS, SceneStatistics
from kornia_tidy.reconstruction.tikhonov_kernels import centred_window, window_and_plane
from kornia_tidy.reconstruction.wiener import inverse_spectrum


def wiener_kernels(psfs: Tensor, noises: tuple[float, ...], statistics: SceneStatistics = PHOTOGRAPHS) -> Tensor:
    r"""Return the kernels of Wiener restoration with one filter for all depths, truncated to a window.

    .. math:: k = \mathcal{F}^{-1} \left[
                  \frac{\bar{\langle H \rangle}}{\langle |H|^2 \rangle + \sigma^2 / S} \right]

    :math:`\langle\rangle` is the mean over depth, weighted by the distribution of depth in scenes, and S the power
    spectrum of scenes. Convolution with them is :func:`~kornia_tidy.reconstruction.wiener.wiener` up to the truncation,
    which bounds the receptive field, so that a picture can be reconstructed in tiles. A constant is added to each
    kernel so that white becomes white.

    Args:
        psfs: (D, C, P, P) with P odd and positive sums, at depths of evenly spaced defocus, from the farthest to
            the nearest.
        noises: standard deviation :math:`\sigma` of the noise for each kernel, in units of full scale.
        statistics: of the scenes; they give S and the weights of the depths.

    Returns:
        (N, C, P + 16, P + 16) for N noises, in the dtype of ``psfs``; gradients reach the PSFs.

    Raises:
        TypeError: if the PSFs are not floating point.
        ValueError: if they are of another shape, or a noise is not positive.

    Source: Wiener (1949); Diaz, Goudail, Loiseaux and Huignard, Optics Letters 34(19) 2970 (2009), for one filter that
    serves all depths.

    Example:
        >>> point = torch.zeros(2, 1, 3, 3)
        >>> point[..., 1, 1] = 0.5
        >>> kernel = wiener_kernels(point, (1e-6,))
        >>> kernel.shape, round(kernel.sum().item(), 3), round(kernel.max().item(), 2)
        (torch.Size([1, 1, 19, 19]), 2.0, 2.0)
    """
    window, size = window_and_plane("psfs", psfs, "(D, C, P, P)")
    for noise in noises:
        check_positive("noise", noise)
    places = torch.linspace(-1.0, 1.0, len(psfs), dtype=torch.float64)
    shares = statistics.depth_weights(places).to(psfs)[:, None, None, None]
    transfer = torch.fft.rfft2(psfs, s=(size, size))
    power = (shares * (transfer.real.square() + transfer.imag.square())).sum(0)
    variances = psfs.new_tensor(noises)[:, None, None, None].square()
    noise_to_scene = variances * inverse_spectrum(statistics, (size, size)).to(psfs)
    inverse = torch.fft.irfft2((shares * transfer).sum(0).conj() / (power + noise_to_scene), s=(size, size))
    return centred_window(inverse, window, (shares * psfs).sum((0, -2, -1)))
