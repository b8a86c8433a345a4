"""Noise of a developed raw file, from the noise profile that the file holds."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from kornia_tidy.lab.raw.develop import balance_factors, srgb_matrix
from kornia_tidy.sensor.sensor import SensorNoise

if TYPE_CHECKING:
    from kornia_tidy.lab.raw.capture import RawCapture

LEAST = 1e-12  # variance, in units of full scale squared


def developed_noise(
    raw: RawCapture, white_balance: str | Tensor | None = None, sensor: SensorNoise | None = None
) -> SensorNoise | None:
    r"""Return the sensor with the noise of a developed picture, the mean of its three colours.

    White balance g and colour matrix M turn the variance :math:`S x + O` of the sensor's values into that of linear
    sRGB. In grey light l it is

    .. math:: \sigma_i^2 = \sum_c M_{ic}^2 \, (g_c S_c \, l + g_c^2 O_c)

    Args:
        raw: the capture.
        white_balance: as for :func:`~kornia_tidy.lab.raw.develop.develop`, with which it is developed.
        sensor: noise that was measured, in units where full scale is the count of saturation. None: that of the noise
            profile in the file.

    Returns:
        Read noise and full well in units of the developed picture's full scale; None if the noise is not known.

    Convention:
        Demosaicing is left out. It averages the noise of interpolated values, which is then less than told.

    Source: DNG 1.7, NoiseProfile.

    Example:
        >>> from dataclasses import replace
        >>> from kornia_tidy.lab.raw.capture import RawCapture, RawInfo
        >>> raw = RawCapture.from_counts(torch.zeros(1, 4, 4), "RGGB", 0, 1023)
        >>> info = RawInfo(noise_profile=((1e-4, 1e-6),))
        >>> developed_noise(replace(raw, camera_to_srgb=torch.eye(3), info=info))
        SensorNoise(read noise 0.001 of full scale, full well 10000 electrons, clipped to [0, 1])
    """
    profile = raw.info.noise_profile if sensor is None else (_profile(sensor),)
    if profile is None:
        return None
    if not raw.colors:
        slope, dark = profile[0]
    else:
        names = "".join(dict.fromkeys(raw.colors))
        factors = balance_factors(raw, white_balance)
        gains = (factors / factors.min())[[raw.colors.index(letter) for letter in names]].double()
        pairs = profile if len(profile) == len(names) else profile[:1] * len(names)
        slopes, offsets = torch.tensor(pairs, dtype=torch.float64).unbind(1)
        squares = srgb_matrix(raw).double().square()
        slope = float((squares @ (gains * slopes)).mean())
        dark = float((squares @ (gains.square() * offsets)).mean())
    return SensorNoise(math.sqrt(max(dark, LEAST)), full_well=1 / slope if slope > 0 else None)


def _profile(sensor: SensorNoise) -> tuple[float, float]:
    """Return the slope and the offset of a sensor's variance over light."""
    dark, full = sensor.std(torch.tensor([0.0, 1.0], dtype=torch.float64)).square().tolist()
    return full - dark, dark
