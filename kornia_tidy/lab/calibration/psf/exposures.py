"""Merging of exposures: several exposures of one scene give a linear image of high dynamic range."""

from __future__ import annotations

import torch
from torch import Tensor

from kornia_tidy.checks import check_float_tensor
from kornia_tidy.lab.calibration.psf.shrinkage import shrink
from kornia_tidy.sensor.sensor import SensorNoise

SATURATION = 0.95  # of full scale; above, noise may have been clipped


def capture_variance(signal: Tensor, sensor: SensorNoise) -> Tensor:
    r"""Return the noise variance of a sensor's values.

    .. math:: \sigma^2 = \frac{s}{F} + \frac{d}{F^2} + \sigma_r^2 + \frac{q^2}{12}

    with F electrons at full scale, a dark signal of d electrons, the read noise and the converter's step q.

    Args:
        signal: s, mean values without noise, 1 at full scale.
        sensor: noise parameters. Without a full well shot noise is left out.

    Returns:
        Variance in units of full scale squared, the shape of ``signal``.

    Source: EMVA Standard 1288, 4.0, section 2.

    Example:
        >>> capture_variance(torch.tensor([0.5]), SensorNoise(0.01, full_well=1e4)) * 1e6
        tensor([150.])
    """
    variance = torch.full_like(signal, sensor.sigma**2)
    if sensor.full_well is not None:
        variance += signal.clamp(min=0) / sensor.full_well + sensor.dark / sensor.full_well**2
    if sensor.bits is not None:
        variance += (2**sensor.bits - 1) ** -2 / 12
    return variance


def merge_exposures(
    frames: Tensor, exposures: Tensor, sensor: SensorNoise, saturation: float = SATURATION
) -> tuple[Tensor, Tensor]:
    r"""Merge several exposures into the light per unit of exposure, weighted by inverse variance.

    .. math:: L = \frac{\sum_e w_e \, t_e y_e}{\sum_e w_e \, t_e^2}, \qquad w_e = 1 / \sigma^2(t_e L)

    The variances are computed from a first estimate of L, which is denoised. The noisy values themselves would give too
    much weight to values that are too low by chance: an average of pixels weighted by them is one electron too low.

    Args:
        frames: y, (..., E, C, H, W) linear, black level subtracted, 1 at full scale, not clamped at zero.
        exposures: t, (E,) in seconds or any other unit, positive.
        sensor: noise of one frame.
        saturation: values at or above this are ignored.

    Returns:
        L and its variance, (..., C, H, W) float64. Where all frames are saturated, L is that of the shortest exposure
        and the variance is infinite.

    Raises:
        TypeError: if the frames are not floating point.
        ValueError: if exposures are not positive or not one a frame.

    Source: Mitsunaga and Nayar, CVPR 1999, for the sum over exposures; weights by inverse variance: Granados et al.,
    CVPR 2010.

    Example:
        >>> frames = torch.tensor([0.1, 1.0]).view(2, 1, 1, 1)  # the longer exposure is saturated
        >>> light, _ = merge_exposures(frames, torch.tensor([1.0, 100.0]), SensorNoise(0.01))
        >>> round(light.item(), 6)
        0.1
    """
    if frames.ndim < 4:
        raise ValueError(f"frames must have shape (..., E, C, H, W), got {tuple(frames.shape)}")
    check_float_tensor("frames", frames, frames.ndim, "(..., E, C, H, W)")
    if tuple(exposures.shape) != (frames.shape[-4],) or not bool((exposures > 0).all() & exposures.isfinite().all()):
        raise ValueError(
            f"exposures must be {frames.shape[-4]} positive numbers, one a frame, got {exposures.tolist()}"
        )
    value, time = frames.double(), exposures.double().view(-1, 1, 1, 1).to(frames.device)
    good = (value < saturation).double()
    shortest = int(exposures.argmin())
    together = (good * time).sum(-4).clamp(min=1e-150)
    light = (good * value).sum(-4) / together
    noise = (good * capture_variance(time * light.unsqueeze(-4), sensor)).sum(-4) / together.square()
    light = shrink(light.flatten(0, -3), noise.flatten(0, -3))[0].view_as(light)
    weight = good / capture_variance(time * light.unsqueeze(-4), sensor).clamp(min=1e-300)
    information = (weight * time.square()).sum(-4)
    merged = (weight * time * value).sum(-4) / information.clamp(min=1e-300)
    measured = information > 0
    return torch.where(measured, merged, value.select(-4, shortest) / exposures[shortest]), 1 / information
