"""Objectives of mask design, and their minimisation by gradient descent without an image or a network.

For depth estimation the objective is the mean of :func:`~kornia_tidy.mask_design.fisher_information.crlb` over defocus.
For extended depth of field it is :func:`restoration_error`, or :func:`point_error` if the image is not restored.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional

from kornia_tidy.checks import check_positive
from kornia_tidy.mask_design.fisher_information import defocus_bound, fisher_information, sampled_response
from kornia_tidy.masks.base import PhaseMasks, adam_groups
from kornia_tidy.masks.zernike import ZernikeMask
from kornia_tidy.optics.aperture import circular_aperture
from kornia_tidy.psf.psf_bank import PSFBank
from kornia_tidy.scene_statistics.statistics import PHOTOGRAPHS, SceneStatistics
from kornia_tidy.sensor.noise import SensorNoise


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


def point_error(bank: PSFBank) -> Tensor:
    r"""Return the squared distance between PSFs and the unit impulse, averaged over defocus and channels.

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
    bank: PSFBank, noise: float | SensorNoise = 0.05, statistics: SceneStatistics = PHOTOGRAPHS
) -> Tensor:
    r"""Return the mean squared error of restoration by one Wiener filter for all depths.

    .. math:: \sum_f S_f \left( 1 - \frac{|\langle H_f \rangle|^2}{\langle |H_f|^2 \rangle + \sigma^2 / S_f} \right)
        \Big/ \sum_f S_f

    H is the transfer function, :math:`\langle\rangle` the mean over the distribution of depth, and S the power spectrum
    of the scenes. The error is low if H is large, so that noise is not amplified, and if it depends little on depth, so
    that one filter fits all depths. A small PSF at one depth only does not suffice, nor does a large PSF that is the
    same at all depths.

    Args:
        bank: PSFs of a lens whose fidelity discards stray light or spreads it over the image; the result is the mean
            over its channels.
        noise: the sensor, whose noise at the scenes' mean light is taken; or the standard deviation of the noise as a
            fraction of that of the scene.
        statistics: of the scenes: spectrum, light and distribution of depth over the nodes of the bank.

    Returns:
        Fraction of the scene's variance, between 0 and 1, 0-dimensional.

    Raises:
        ValueError: if the noise is not positive.

    Source: Diaz, Goudail, Loiseaux and Huignard, Optics Letters 34(19) 2970 (2009), for the error after one filter as
    an objective of mask design.

    Example:
        >>> point = torch.zeros(2, 1, 9, 9)
        >>> point[..., 4, 4] = 1
        >>> bank = PSFBank(point, torch.tensor([-1.0, 1.0]), torch.ones(2, 1))
        >>> bool(restoration_error(bank, noise=1e-3) < 1e-4)
        True
    """
    variance = _noise_variance(noise, statistics)
    size = 2 * bank.window
    scene = statistics.cell_power(size).to(bank.psfs.device) / statistics.spread**2
    count = torch.full_like(scene, 2.0)  # the real transform omits the conjugate frequencies
    count[:, 0] = count[:, -1] = 1
    noise_ratio = variance * count / size**2 / scene.clamp(min=torch.finfo(scene.dtype).tiny)
    transfer = torch.fft.rfft2(bank.psfs.to(torch.promote_types(bank.psfs.dtype, torch.float32)), s=(size, size))
    if bank.veil is not None:
        transfer = transfer + functional.pad(bank.veil[..., None, None], (0, size // 2, 0, size - 1))
    share = statistics.depth_weights(bank.defocus).to(transfer.real)[:, None, None, None]
    mean = (share * transfer).sum(0)
    power = (share * (transfer.real.square() + transfer.imag.square())).sum(0)
    restored = (mean.real.square() + mean.imag.square()) / (power + noise_ratio.to(power))
    return (scene.to(power) * (1 - restored)).sum((-2, -1)).mean()


def _noise_variance(noise: float | SensorNoise, statistics: SceneStatistics) -> float:
    """Return the variance of the noise as a fraction of that of the scene."""
    if isinstance(noise, SensorNoise):  # its variance is linear in the light, so that at the mean is the mean one
        noise = float(noise.std(torch.tensor(statistics.mean, dtype=torch.float64))) / statistics.spread
    check_positive("noise", noise)
    return noise**2


def design_fisher_mask(
    limit: float = 10.0, seed: int = 0, size: int = 23, num_modes: int = 55, iterations: int = 150
) -> tuple[ZernikeMask, float]:
    """Design a mask for depth estimation in the published setting, by its mean Cramér-Rao bound over defocus.

    The bound is that of :func:`sampled_response` at 21 depths, with 3000 photons, a background of 5 photons in each of
    64 x 64 pixels, and unknown defocus and position. For another range, camera or spectrum, :func:`design` the masks of
    a lens by its :func:`~kornia_tidy.mask_design.fisher_information.crlb`.

    Args:
        limit: largest defocus in radians on either side of focus; beyond 10 rad light leaves the 64 x 64 pixels.
        seed: seed of the initial Zernike coefficients, 0.5 rad rms in all.
        size: pixels along a side of the mask.
        num_modes: number of Zernike polynomials.
        iterations: gradient steps; 150 take 4 s on one core.

    Returns:
        The mask, and its mean bound in radians. With the defaults this is 0.0668 to 0.0671 for seeds 0 to 5.

    Raises:
        ValueError: if ``limit`` or ``iterations`` is not positive.

    Source: Wu et al., PhaseCam3D (ICCP 2019), section 3, for a mask designed in this way, whose bound is 0.0785;
    Shechtman et al., Physical Review Letters 113, 133902 (2014), for the tetrapod PSF that results.

    Example:
        >>> mask, bound = design_fisher_mask(iterations=2)
        >>> mask.phase.shape, bound < 1
        (torch.Size([1, 23, 23]), True)
    """
    check_positive("limit", limit, "radians")
    start = 0.5 / math.sqrt(num_modes) * torch.randn(num_modes, generator=torch.Generator().manual_seed(seed))
    mask = ZernikeMask(1, size, num_modes, initial=start).double()
    aperture = circular_aperture(size, 2.3 / size)
    nodes = torch.linspace(-limit, limit, 21, dtype=torch.float64).tolist()

    def mean_bound() -> Tensor:
        return defocus_bound(fisher_information(sampled_response(mask.phase, aperture, nodes))).mean()

    design(mask, mean_bound, iterations, lr_metres=8.4e-9)
    return mask, float(mean_bound().detach())
