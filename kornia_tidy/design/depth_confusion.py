"""How well a camera tells the depths of textured patches apart, and how well it restores them by that depth."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from kornia_tidy.checks import check_positive
from kornia_tidy.data.scene_statistics import PHOTOGRAPHS, SceneStatistics
from kornia_tidy.psf.psf_bank import PSFBank

CONTRASTS = (1 / 16, 1 / 2, 4.0)  # of a patch's variance to that of all scenes, equally frequent
SAMPLES = 20.0  # of a patch that count
MISFIT = 10.0  # times the variance of the noise, as one PSF does not explain all light
# Share of a patch's power that depth edges and other depths within the PSF add without blur. With it the prediction is
# within .02 of the RMSE of closed-form estimates on nine real scenes, of .18 to .26; without it, it is .08 too low at
# f/12.5.
OTHER_DEPTHS = 3e-3


class DepthConfusion(NamedTuple):
    """Expected errors of a camera that tells depth by texture, each 0-dimensional."""

    depth: Tensor
    """RMSE of normalised inverse depth, as a fraction of the range."""
    image: Tensor
    """Mean squared error of the image, as a fraction of the variance of light."""


def depth_confusion(bank: PSFBank, noise: float, statistics: SceneStatistics = PHOTOGRAPHS) -> DepthConfusion:
    r"""Return the expected errors of depth and image, if depth is estimated by the texture of each patch.

    A patch is a Gaussian texture of unknown contrast a, seen with the PSF of one depth. The probability of estimating
    the depth d' of a patch at depth d is taken from the mean of its log likelihood, which is the Kullback-Leibler
    divergence of N samples:

    .. math::
        q_{dd'} \propto \pi_{d'} \sum_{a'} \exp (-N D_{da, d'a'}), \quad
        D_{ij} = \tfrac12 \langle \frac{P_i}{P_j} - 1 - \log \frac{P_i}{P_j} \rangle_f, \quad
        P_{daf} = a \, S_f \, (|H_{df}|^2 + \epsilon) + 10 \, \sigma^2

    with the power spectrum S of the scenes, the transfer function H of the PSF, and the distribution of depth
    :math:`\pi`. The errors are those of estimates drawn from it,

    .. math::
        E_{depth}^2 = \tfrac12 \sum_{dd'} \pi_d \, q_{dd'} \, (x_{d'} - x_d)^2, \qquad
        E_{image} = \sum_{dd'} \pi_d \, q_{dd'}
            \frac{\langle S_f |1 - G_{d'f} H_{df}|^2 + \sigma^2 |G_{d'f}|^2 \rangle}{\langle S_f \rangle}

    where G is the Wiener filter for all patches of the same estimate, with true depths distributed as
    :math:`\pi_d \, q_{dd'}`. Half the squared error is the variance of the range if nothing is known, as for an
    estimate by the mean.

    Args:
        bank: PSFs of at least two depths, evenly spaced over the range of inverse depth.
        noise: standard deviation :math:`\sigma` of the noise in linear light, full scale 1.
        statistics: of the scenes.

    Returns:
        Both errors, differentiable with respect to the PSFs, in grey light.

    Raises:
        ValueError: if the noise is not positive.

    Source: Levin, Fergus, Durand and Freeman, Image and Depth from a Conventional Camera with a Coded Aperture
    (SIGGRAPH 2007), section 3.1: the Kullback-Leibler divergence between captures at different depths as the criterion
    of an aperture.

    Example:
        >>> x = torch.arange(15) - 7
        >>> widths = torch.linspace(0.5, 4, 5)[:, None, None]
        >>> psfs = torch.exp(-(x[:, None] ** 2 + x**2) / (2 * widths**2))
        >>> psfs = (psfs / psfs.sum((1, 2), keepdim=True))[:, None]
        >>> found = depth_confusion(PSFBank(psfs, torch.linspace(-1, 1, 5), torch.ones(5, 1)), noise=1e-3)
        >>> alike = psfs[:1].expand(5, -1, -1, -1)
        >>> nothing = depth_confusion(PSFBank(alike, torch.linspace(-1, 1, 5), torch.ones(5, 1)), noise=1e-3)
        >>> bool(found.depth < 0.5 * nothing.depth)
        True
    """
    check_positive("noise", noise)
    size, depths = 2 * bank.window, len(bank.psfs)
    psfs = bank.psfs.mean(1).to(torch.promote_types(bank.psfs.dtype, torch.float32))
    transfer = torch.fft.rfft2(psfs, s=(size, size)).flatten(1)
    squared = transfer.real.square() + transfer.imag.square()
    spectrum, share = _spectrum_and_shares(statistics, size)
    spectrum, share = spectrum.to(psfs), share.to(psfs)
    prior = statistics.depth_weights(bank.defocus).to(psfs)

    contrasts = psfs.new_tensor(CONTRASTS)[:, None]
    power = (contrasts * ((squared + OTHER_DEPTHS) * spectrum)[:, None] + MISFIT * noise**2).flatten(0, 1)
    logarithm = (power.log() * share).sum(1)
    divergence = 0.5 * ((power * share) @ power.reciprocal().mT - 1 - logarithm[:, None] + logarithm)
    likelihood = (-SAMPLES * divergence).unflatten(0, (depths, -1)).unflatten(2, (depths, -1)).logsumexp(-1)
    estimated = (likelihood + prior.log()).softmax(-1).mean(1)
    place = torch.linspace(0, 1, depths).to(psfs)
    depth = (estimated * (place - place[:, None]).square()).sum(1) @ prior / 2

    joint = estimated * prior[:, None]  # probability of the true depth and the estimated one
    true = joint / joint.sum(0)
    wiener = (true.mT.to(transfer) @ transfer.conj()) / (true.mT @ squared + noise**2 / spectrum)
    gain = wiener.real.square() + wiener.imag.square()
    weight = spectrum * share
    left = weight.sum() - 2 * ((transfer * weight) @ wiener.mT).real + (squared * weight) @ gain.mT
    image = (joint * (left + noise**2 * (gain @ share))).sum() / weight.sum()
    return DepthConfusion(depth.sqrt(), image)


def _spectrum_and_shares(statistics: SceneStatistics, size: int) -> tuple[Tensor, Tensor]:
    """Return the power spectrum, and the share of each frequency of the half plane in a mean without frequency zero."""
    down, across = torch.fft.fftfreq(size, dtype=torch.float64), torch.fft.rfftfreq(size, dtype=torch.float64)
    frequency = torch.hypot(down[:, None], across)
    share = torch.full_like(frequency, 2.0)  # the half spectrum omits the conjugate frequencies
    share[:, 0] = share[:, -1] = 1.0
    share[0, 0] = 0.0
    return statistics.spectrum(frequency).flatten(), (share / share.sum()).flatten()
