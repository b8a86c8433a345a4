"""Denoising of measured PSFs: shrinkage towards local means, because most of a window has noise but little light."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d

SCALES = (15, 5, 1)  # pixels along a side


def shrink(psf: Tensor, variance: Tensor) -> tuple[Tensor, Tensor]:
    r"""Denoise a measured PSF by shrinking each value towards a local mean, by a local signal-to-noise ratio.

    .. math:: \hat{h}_n = \hat{h}_{n+1} + g \, (m_n - \hat{h}_{n+1}), \qquad g = \frac{s^2}{s^2 + \bar{v}_n}

    Here :math:`m_n` are the means of smaller and smaller neighbourhoods down to the pixel itself, and :math:`v_n` the
    variance of their noise. The signal :math:`s^2` is the mean square of :math:`m_n - \hat{h}_{n+1}` minus that of the
    noise, or zero. Bright structure has g near one and hardly changes. Empty parts get the mean of a wide
    neighbourhood, so no light is lost.

    Args:
        psf: h, (C, M, M).
        variance: v, (C, M, M).

    Returns:
        The PSF and its expected square error, :math:`e_n = g v_n + (1 - g)^2 e_{n+1}`, (C, M, M) each.

    Source: Lee, IEEE Transactions on Pattern Analysis and Machine Intelligence 2(2) 165 (1980), at several scales.

    Example:
        >>> empty = 0.1 * torch.randn(1, 64, 64, generator=torch.Generator().manual_seed(0))
        >>> quiet, _ = shrink(empty, torch.full((1, 64, 64), 0.01))
        >>> bool(quiet.std() < 0.25 * empty.std()), bool((quiet.mean() - empty.mean()).abs() < 2e-3)
        (True, True)
    """
    mean, error = _local_mean(psf, SCALES[0]), _local_mean(variance, SCALES[0]) / SCALES[0] ** 2
    for wide, side in pairwise(SCALES):
        finer, noise = _local_mean(psf, side), _local_mean(variance, side) / side**2
        usual = _local_mean(noise, wide)
        signal = (_local_mean((finer - mean).square(), wide) - usual).clamp(min=0)
        gain = signal / (signal + usual).clamp(min=torch.finfo(psf.dtype).tiny)
        mean, error = mean + gain * (finer - mean), gain * noise + (1 - gain).square() * error
    return mean, error


def _local_mean(values: Tensor, side: int) -> Tensor:
    return avg_pool2d(values[None], side, 1, side // 2, count_include_pad=False)[0]
