"""Pixel values: sRGB and linear light, and the moments of sensor noise."""

from __future__ import annotations

import math

import numpy as np

Array = np.ndarray


def decode(image: Array) -> Array:
    """Return linear light from sRGB. Source: IEC 61966-2-1."""
    return np.where(image <= 0.04045, image / 12.92, (np.maximum(image, 0.04045) / 1.055 + 0.055 / 1.055) ** 2.4)


def encode(light: Array) -> Array:
    """Return sRGB from linear light. Source: IEC 61966-2-1."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 0.0031308) ** (1 / 2.4) - 0.055)


def noise_moments(
    light: float,
    sigma: float,
    full_well: float | None = None,
    dark: float = 0.0,
    bits: int | None = None,
    *,
    clip: bool = False,
) -> tuple[float, float, float]:
    r"""Return mean, variance and fourth central moment of a sensor's reading of constant light, full scale 1.

    Electrons N are Poisson with the mean :math:`\lambda = L F + D` of full well F and dark signal D; ``clip`` cuts them
    at F. The reading is :math:`(N - D) / F` plus Gaussian read noise, rounded to the converter's levels; ``clip`` cuts
    it to [0, 1]. The moments are sums over all electrons and over 4001 points of the read noise.
    Source: EMVA Standard 1288, 4.0, section 2.
    """
    value, chance = np.array([light]), np.array([1.0])
    if full_well is not None:
        mean = light * full_well + dark
        count = np.arange(int(mean + 12 * math.sqrt(mean) + 30))
        chance = np.exp(count * math.log(max(mean, 1e-300)) - mean - np.array([math.lgamma(k + 1) for k in count]))
        value = ((np.minimum(count, full_well) if clip else count) - dark) / full_well
    if sigma > 0:
        z = np.linspace(-8, 8, 4001)
        bell = np.exp(-(z**2) / 2)
        value = value[:, None] + sigma * z
        chance = chance[:, None] * (bell / bell.sum())
    if bits is not None:
        value = np.round(value * (2**bits - 1)) / (2**bits - 1)
    if clip:
        value = np.clip(value, 0, 1)
    mean = float(np.sum(chance * value))
    return mean, float(np.sum(chance * (value - mean) ** 2)), float(np.sum(chance * (value - mean) ** 4))
