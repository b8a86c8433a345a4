"""Noise of a measured PSF taken back where it holds no light: most of a window is nearly empty, and all of it noisy."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

NEIGHBOURHOOD = 5  # pixels along a side


def shrink(psf: Tensor, variance: Tensor) -> tuple[Tensor, Tensor]:
    r"""Return each value moved to the mean of its surroundings, the more the less these differ beyond the noise.

    .. math:: \hat{h} = m + g \, (h - m), \qquad g = \frac{s^2}{s^2 + \bar{v}}

    with m the local mean, v the variance of the noise, and :math:`s^2` the local variance of the values less that of
    the noise, or zero. Bright structure keeps its noise, for its g is near one; empty parts get their mean, so that no
    light is lost.

    Args:
        psf: h, (C, M, M).
        variance: v, (C, M, M).

    Returns:
        The PSF and its expected square error, :math:`g v + (1 - g)^2 \bar{v} / n`, (C, M, M) each.

    Source: Lee, IEEE Transactions on Pattern Analysis and Machine Intelligence 2(2) 165 (1980).

    Example:
        >>> empty = 0.1 * torch.randn(1, 64, 64, generator=torch.Generator().manual_seed(0))
        >>> quiet, _ = shrink(empty, torch.full((1, 64, 64), 0.01))
        >>> bool(quiet.std() < 0.3 * empty.std()), bool((quiet.mean() - empty.mean()).abs() < 1e-3)
        (True, True)
    """
    mean, noise = _local_mean(psf), _local_mean(variance)
    signal = (_local_mean((psf - mean).square()) - noise).clamp(min=0)
    gain = signal / (signal + noise).clamp(min=torch.finfo(psf.dtype).tiny)
    return mean + gain * (psf - mean), gain * variance + (1 - gain).square() * noise / NEIGHBOURHOOD**2


def _local_mean(values: Tensor) -> Tensor:
    return avg_pool2d(values[None], NEIGHBOURHOOD, 1, NEIGHBOURHOOD // 2, count_include_pad=False)[0]
