"""Likelihood of each depth in closed form: how well a patch of the capture fits the spectrum of its PSF."""

from __future__ import annotations

import math

import torch
from kornia.filters import gaussian_blur2d
from torch import Tensor

from kornia_tidy.checks import check_positive, check_values
from kornia_tidy.reconstruction.kernel_convolution import convolve_kernels
from kornia_tidy.reconstruction.tikhonov import transfer_function
from kornia_tidy.reconstruction.truncation import SIDE, plane_of, truncated
from kornia_tidy.render.borders import pad_border

CONTRASTS = (0.02, 0.06, 0.2)  # standard deviations of the light of a scene, of full scale
NOISE = 4e-3  # standard deviation of the model's error, of full scale: sensor noise, depth edges
EXPONENT, KNEE = 2.9, 1 / 256  # of the power spectrum of real scenes in linear light: f^-2.9 above 1/256 cycles a pixel
# Its integral over the circle of half a cycle a pixel; over a plane of a few PSFs it would not be resolved.
VARIANCE = math.pi / (EXPONENT / 2 - 1) * (KNEE ** (2 - EXPONENT) - (0.25 + KNEE**2) ** (1 - EXPONENT / 2))
PATCH = 2.5  # pixels, standard deviation of the Gaussian window of a patch
LARGEST = 25.0  # limit of a sample's energy, on average 1: an edge that no depth explains must not decide alone
MEAN = 0.3  # light of a scene, of full scale
_SPARE = 0.5  # of the samples of a patch that count, as its pixels are not independent after truncation


def likelihood_filters(psfs: Tensor, noise: float = NOISE) -> tuple[Tensor, Tensor]:
    r"""Return filters that whiten a capture of a scene at each depth and contrast, and their log determinants.

    .. math:: g_{ak} = \mathcal{F}^{-1} [ P_{ak}^{-1/2} ], \quad P_{ak} = a^2 |H_k|^2 S + \sigma^2, \quad
              \ell_{ak} = \overline{\log P_{ak}}

    Args:
        psfs: (L, P, P) with P odd, of linear light.
        noise: :math:`\sigma`, of full scale.

    Returns:
        Filters (3 L, 3 P, 3 P) and log determinants (3 L,), for each of 3 contrasts a all L depths. S is the power
        spectrum of real scenes, with a variance of one.

    Raises:
        ValueError: if the noise is not positive.
    """
    check_positive("noise", noise)
    side, size = SIDE * psfs.shape[-1], plane_of(psfs)
    transfer = transfer_function(psfs, (size, size))
    rows = torch.fft.fftfreq(size, dtype=psfs.dtype, device=psfs.device)[:, None]
    columns = torch.fft.rfftfreq(size, dtype=psfs.dtype, device=psfs.device)
    share = torch.full_like(columns, 2.0)  # the half spectrum holds all columns but the first and the last twice
    share[0] = 1.0
    if size % 2 == 0:
        share[-1] = 1.0
    share = (share / size**2).expand(size, -1)
    spectrum = 1 / VARIANCE * (rows.square() + columns.square() + KNEE**2) ** (-EXPONENT / 2)
    contrasts = torch.tensor(CONTRASTS, dtype=psfs.dtype, device=psfs.device).view(-1, 1, 1, 1)
    power = (transfer.real.square() + transfer.imag.square()) * spectrum
    power = (contrasts.square() * power + noise**2).flatten(0, 1)
    filters = torch.fft.irfft2(power.rsqrt(), s=(size, size))
    return truncated(filters, side), (power.log() * share).sum((-2, -1))


def depth_likelihood(light: Tensor, filters: Tensor, log_determinants: Tensor) -> Tensor:
    r"""Return the log likelihood of each depth from the patch around each pixel, up to a constant.

    .. math:: \log p_k(x) = \log \sum_a \exp \Big( -\frac{N}{2}
                \big[ ( (g_{ak} * y)^2 * w )(x) + \ell_{ak} \big] \Big)

    It is that of a Gaussian scene of unknown contrast; the patch w of N samples is at one depth. On a blank wall all
    depths are about equally likely. Squares are limited to 25.

    Args:
        light: y, (B, 1, H, W), brightness of a capture in linear light.
        filters: of :func:`likelihood_filters`.
        log_determinants: of :func:`likelihood_filters`.

    Returns:
        (B, L, H, W), with a maximum of zero at each pixel.

    Source: Levin et al., Image and Depth from a Conventional Camera with a Coded Aperture (SIGGRAPH 2007), 3: a
    Gaussian prior decides between the PSFs of several depths; here in the frequencies of a patch, as in Zhu et al.,
    Estimating Spatially Varying Defocus Blur from a Single Image (TIP 2013).

    Example:
        >>> psfs = torch.rand(4, 5, 5, generator=torch.Generator().manual_seed(0))
        >>> psfs = psfs / psfs.sum((1, 2), keepdim=True)
        >>> depth_likelihood(torch.rand(1, 1, 20, 30), *likelihood_filters(psfs)).shape
        torch.Size([1, 4, 20, 30])
    """
    check_values("a new tensor", torch.empty(0))  # kornia makes some
    energy = convolve_kernels(light - MEAN, filters.unsqueeze(1)).squeeze(2).square().clamp(max=LARGEST)
    samples = _SPARE * 2 * math.pi * PATCH**2
    fit = -0.5 * samples * (_patch_mean(energy) + log_determinants.view(-1, 1, 1))
    likelihood = fit.unflatten(1, (len(CONTRASTS), -1)).logsumexp(1)
    return likelihood - likelihood.amax(1, keepdim=True)


def _patch_mean(energy: Tensor) -> Tensor:
    radius = math.ceil(3 * PATCH)
    border = "reflect" if radius < min(energy.shape[-2:]) else "replicate"
    padded = pad_border(energy, radius, border)
    side = 2 * radius + 1
    blurred = gaussian_blur2d(padded, (side, side), (PATCH, PATCH), border_type="constant")
    return blurred[..., radius:-radius, radius:-radius]
