"""Objectives of mask design, and their minimisation by gradient descent without an image or a network.

For depth by texture the objective is :func:`~kornia_tidy.design.depth_confusion.depth_confusion`, for that of
points the mean of :func:`~kornia_tidy.design.fisher_information.crlb` over defocus. For extended depth of field it
is :func:`restoration_error`, or :func:`point_error` if the image is not restored.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from kornia_tidy.checks import check_positive
from kornia_tidy.data.scene_statistics import PHOTOGRAPHS, SceneStatistics
from kornia_tidy.masks.base import PhaseMasks, adam_groups
from kornia_tidy.psf.field_bank import FieldBank
from kornia_tidy.psf.psf_bank import PSFBank
from kornia_tidy.sensor.sensor import SensorNoise


def design(
    masks: PhaseMasks, objective: Callable[[], Tensor], iterations: int = 150, lr_metres: float = 2e-8
) -> list[float]:
    """Optimise masks in place: minimise an objective by Adam with a learning rate that decays to zero along a cosine.

    Args:
        masks: masks of any family.
        objective: function without arguments that returns the value to minimise, for example of a lens with these
            masks.
        iterations: gradient steps.
        lr_metres: initial learning rate in metres of height, see :func:`adam_groups`.

    Returns:
        The value of the objective before each step.

    Raises:
        ValueError: if the iterations or the learning rate are not positive.

    Example:
        >>> from kornia_tidy.masks.pixelwise import PixelwiseMask
        >>> from kornia_tidy.psf.psf_model import PSFModel
        >>> lens = PSFModel(PixelwiseMask(1), fidelity="draft")
        >>> history = design(lens.masks, lambda: point_error(lens.psf_bank(channels=1)), iterations=10)
        >>> len(history), history[-1] < history[0]
        (10, True)
    """
    check_positive("iterations", iterations)
    optimizer = torch.optim.Adam([adam_groups(masks, lr_metres)])
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, iterations)
    history = []
    for _ in range(iterations):
        optimizer.zero_grad()
        value = objective()
        value.backward()
        optimizer.step()
        schedule.step()
        history.append(float(value.detach()))
    return history


def point_error(bank: PSFBank | FieldBank) -> Tensor:
    r"""Return the squared distance between PSFs and the unit impulse, averaged over defocus, channels and field.

    .. math:: \frac{1}{DC} \sum_{dc} \| h_{dc} - \delta \|^2

    It is 1 if the light is spread over many pixels, and 0 for a perfect point at all depths.

    Args:
        bank: PSFs of a lens whose fidelity discards stray light. Otherwise the renormalised window would reward masks
            that scatter light out of it.

    Returns:
        0-dimensional, without unit.

    Source: Shah et al., TiDy-PSFs (ICCV 2023), the experiment on extended depth of field without a network.

    Example:
        >>> point = torch.zeros(1, 1, 3, 3)
        >>> point[..., 1, 1] = 0.5
        >>> point_error(PSFBank(point, torch.zeros(1), torch.ones(1, 1)))
        tensor(0.2500)
    """
    centre = bank.window // 2
    return (bank.psfs.square().sum((-2, -1)) - 2 * bank.psfs[..., centre, centre] + 1).mean()


def restoration_error(
    bank: PSFBank | FieldBank, noise: float | SensorNoise = 0.05, statistics: SceneStatistics = PHOTOGRAPHS
) -> Tensor:
    r"""Return the mean squared error, in sRGB, of restoration by one Wiener filter for all depths.

    .. math:: G_f = \frac{\bar{\langle H_f \rangle}}{\langle |H_f|^2 \rangle + \sigma^2 / S_f}, \qquad
              u_d = \mathcal{F}^{-1} [G H_d - 1], \qquad
              \sum_f S_f \langle |\mathcal{F}[w u_d]_f|^2 \rangle + m^2 \langle (w - 1) u_d \rangle^2
              + \sum_r g_r^2 \, (\sigma_r^2 + \sigma_s^2 \, (w * \langle h \rangle)_r)

    H is the transfer function of the PSF h, :math:`\langle\rangle` the mean over the distribution of depth, S the power
    spectrum of the scenes and m their mean light, g the impulse response of the filter G, and :math:`\sigma_r^2` and
    :math:`\sigma_s^2` the variances of read noise and of shot noise at the mean light. The weight w is
    :meth:`~kornia_tidy.data.SceneStatistics.light_around`. With w = 1 this is the error in linear light,
    :math:`\sum_f S_f (1 - |\langle H_f \rangle|^2 / (\langle |H_f|^2 \rangle + \sigma^2 / S_f))`.

    The error is low if H is large, so that noise is not amplified, and if it depends little on depth, so that one
    filter fits all depths. A small PSF at one depth only does not suffice, nor does a large PSF that is the same at all
    depths. A halo, the filter's error far from a point, counts more than its error nearby: halos of bright
    objects show on dark ones.

    Args:
        bank: PSFs of a lens whose fidelity discards stray light or spreads it over the image; the result is the mean
            over its channels. Windows that cut off much of the light, or are renormalised, give errors too low. Of PSFs
            over the field it is the mean over the points, each with the filter of its place.
        noise: the sensor, with its shot and read noise; or the standard deviation of noise that is the same in all
            pixels, as a fraction of the standard deviation of the scenes' light.
        statistics: of the scenes. Their distribution of depth is spread over the nodes of the bank.

    Returns:
        Fraction of the error of an image that has the scenes' mean everywhere, 0-dimensional.

    Raises:
        ValueError: if the noise is not positive.

    Convention:
        - Errors in sRGB are those in linear light times the slope of the curve; clipping is not included.

    Source: Diaz, Goudail, Loiseaux and Huignard, Optics Letters 34(19) 2970 (2009), for the error after one filter as
    an objective of mask design. The weight is our own: if the logarithm of light is a Gaussian process, and the slope a
    power of light, the mean of squared slope times squared error factorises in this way exactly.

    Example:
        >>> point = torch.zeros(2, 1, 9, 9)
        >>> point[..., 4, 4] = 1
        >>> bank = PSFBank(point, torch.tensor([-1.0, 1.0]), torch.ones(2, 1))
        >>> bool(restoration_error(bank, noise=1e-3) < 1e-4)
        True
    """
    if isinstance(bank, FieldBank):
        places = [restoration_error(bank.at(index), noise, statistics) for index in range(len(bank.psfs))]
        return torch.stack(places).mean()
    read, shot = _noise_variances(noise, statistics)
    size = 2 * bank.window
    precise = torch.promote_types(bank.psfs.dtype, torch.float32)
    scene = statistics.cell_power(size).to(bank.psfs.device)
    count = torch.full_like(scene, 2.0)  # the real transform omits the conjugate frequencies
    count[:, 0] = count[:, -1] = 1
    noise_ratio = (read + shot) * count / size**2 / scene.clamp(min=torch.finfo(scene.dtype).tiny)
    transfer = torch.fft.rfft2(bank.psfs.to(precise), s=(size, size))
    if bank.veil is not None:
        transfer = transfer + functional.pad(bank.veil[..., None, None], (0, size // 2, 0, size - 1))
    share = statistics.depth_weights(bank.defocus).to(precise)[:, None, None, None]
    mean = (share * transfer).sum(0)
    gain = mean.conj() / ((share * _squared(transfer)).sum(0) + noise_ratio.to(precise))
    around = _light_around(statistics, size).to(bank.psfs.device, precise)

    left = torch.fft.irfft2(gain * transfer - 1, s=(size, size))
    power = (scene.to(precise) * _squared(torch.fft.rfft2(left * around)) * share).sum((0, 2, 3))
    shade = statistics.mean * (left * (around - 1)).sum((-2, -1), keepdim=True)
    light = torch.fft.irfft2(torch.fft.rfft2(around) * mean.conj(), s=(size, size))
    noise_left = (torch.fft.irfft2(gain, s=(size, size)).square() * (read + shot * light)).sum((-2, -1))
    # Of the scene's mean everywhere: nothing but the point itself is left.
    black = (statistics.spread * statistics.shade) ** 2 + (statistics.mean * (1 - statistics.shade)) ** 2
    return (power + (share * shade.square()).sum((0, 2, 3)) + noise_left).mean() / black


class _Variances(NamedTuple):
    """Variance of the noise in units of the square of full scale."""

    read: float
    """In all pixels alike."""
    shot: float
    """At the mean light, and in proportion to light elsewhere."""


def _noise_variances(noise: float | SensorNoise, statistics: SceneStatistics) -> _Variances:
    if not isinstance(noise, SensorNoise):
        check_positive("noise", noise)
        return _Variances((noise * statistics.spread) ** 2, 0.0)
    dark, mean = noise.std(torch.tensor([0.0, statistics.mean], dtype=torch.float64)).square().tolist()
    check_positive("noise of the sensor", mean)
    return _Variances(dark, mean - dark)


def _light_around(statistics: SceneStatistics, size: int) -> Tensor:
    """Return the light around a pixel at the corner of a periodic plane, (N, N) float64."""
    offset = torch.fft.fftfreq(size, 1 / size, dtype=torch.float64)
    return statistics.light_around(torch.hypot(offset[:, None], offset))


def _squared(spectrum: Tensor) -> Tensor:
    return spectrum.real.square() + spectrum.imag.square()
