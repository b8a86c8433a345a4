"""Error of photographs that is expected after restoration by kernels, from PSFs and the statistics of scenes."""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from torch import Tensor

from kornia_tidy.data.scene_statistics import PHOTOGRAPHS
from kornia_tidy.reconstruction.tikhonov import transfer_function
from kornia_tidy.reconstruction.wiener import transfer_moments
from kornia_tidy.reconstruction.wiener_kernels import wiener_kernels
from kornia_tidy.render.borders import next_fast_size


def best_wiener_kernels(psfs: Tensor, noises: tuple[float, ...]) -> Tensor:
    r"""Return Wiener kernels of bounded size, each for its noise or for a larger one if that is better.

    Where PSFs fill their window, such as those of random masks, the inverse for little noise reaches far beyond it, and
    truncating the inverse adds more error than it removes. The kernel for a noise :math:`\sigma` has the least cost of
    those of :func:`~kornia_tidy.reconstruction.wiener_kernels.wiener_kernels` for :math:`\sigma` and all larger
    noises. The cost of a kernel k is

    .. math:: \int S \, \big\langle |1 - K H|^2 \big\rangle \, df + \sigma^2 \lVert k \rVert_2^2 .

    Args:
        psfs: as for ``wiener_kernels``.
        noises: standard deviations, ascending in equal ratios; up to two more are tried.

    Returns:
        (N, C, P + 16, P + 16) for N noises; gradients reach the PSFs, and not the choice.

    Example:
        >>> point = torch.zeros(2, 1, 3, 3)
        >>> point[..., 1, 1] = 1.0
        >>> torch.equal(best_wiener_kernels(point, (0.01, 0.1)), wiener_kernels(point, (0.01, 0.1)))
        True
    """
    kernels = wiener_kernels(psfs, noises)
    chosen = _least_costs(psfs, kernels, noises)
    if chosen[-2] > len(noises) - 2:  # more noise is better than the second largest: than the largest too?
        ratio = noises[-1] / noises[-2]
        more = wiener_kernels(psfs, (noises[-1] * ratio, noises[-1] * ratio**2))
        kernels = torch.cat([kernels, more])
        chosen = _least_costs(psfs, kernels, noises)
    return kernels[chosen]


@torch.no_grad()
def _least_costs(psfs: Tensor, kernels: Tensor, noises: tuple[float, ...]) -> list[int]:
    """Return for each noise which of the kernels from its own on has the least error and noise."""
    errors, _ = predicted_errors(psfs, kernels)
    norms = kernels.square().sum((-2, -1)).mean(1)
    return [first + int((errors + noise**2 * norms)[first:].argmin()) for first, noise in enumerate(noises)]


def predicted_errors(psfs: Tensor, kernels: Tensor) -> tuple[Tensor, Tensor]:
    r"""Return the mean squared error of photographs without noise by each kernel, and their detail behind the camera.

    .. math:: \int S \, \big\langle |1 - K H|^2 \big\rangle \, df, \qquad
              \int S \, \langle |H|^2 \rangle (2 - \cos 2 \pi f_x - \cos 2 \pi f_y) \, df

    Args:
        psfs: (D, C, P, P) with P odd, at depths of evenly spaced defocus, from the farthest to the nearest.
        kernels: (N, C, Q, Q) with Q odd.

    Returns:
        (N,) in linear light, mean over the colours; and the detail of captures without noise, a scalar, see
        :func:`~kornia_tidy.reconstruction.ruled_closed_form.light_detail`.

    Example:
        >>> point = torch.zeros(2, 1, 3, 3)
        >>> point[..., 1, 1] = 1.0
        >>> errors, _ = predicted_errors(point, torch.cat([point[:1], 0.5 * point[:1]]))
        >>> bool(errors[0].abs() < 1e-6), bool(errors[1] > 10 * errors[0].abs())
        (True, True)
    """
    side = next_fast_size(psfs.shape[-1] + kernels.shape[-1])
    size = (side, side)
    moments = transfer_moments(psfs, size, depth_shares(psfs))
    inverse = transfer_function(kernels, size)
    power = _scene_power(side).to(psfs)
    squared = inverse.real.square() + inverse.imag.square()
    left = 1 - 2 * (inverse * moments.mean).real + squared * moments.power
    down, across = torch.fft.fftfreq(side)[:, None], torch.fft.rfftfreq(side)
    differences = (2 - (2 * math.pi * down).cos() - (2 * math.pi * across).cos()).to(psfs)
    return (left * power).sum((-2, -1)).mean(1), (moments.power.mean(0) * differences * power).sum()


def depth_shares(psfs: Tensor) -> Tensor:
    """Return the share of pixels of photographs at each depth, from the farthest to the nearest, (D,)."""
    return PHOTOGRAPHS.depth_weights(torch.linspace(-1.0, 1.0, len(psfs), dtype=torch.float64)).to(psfs)


@lru_cache(maxsize=4)
def _scene_power(side: int) -> Tensor:
    """Return the power of photographs on a half spectrum, but that of white, which is restored; it is not changed."""
    power = PHOTOGRAPHS.cell_power(side)
    power[0, 0] = 0
    return power
