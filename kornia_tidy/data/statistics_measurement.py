"""Measurement of scene statistics from pictures and depth maps."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb
from torch import Tensor

from kornia_tidy.checks import check_float_tensor
from kornia_tidy.data.scene_statistics import SceneStatistics

DEPTH_PARTS = 8
BINS = 24  # of frequency, equally wide on a logarithmic scale
LOWEST = 4.0  # periods of the lowest fitted frequency within a picture; the window widens lines to 2
ERROR = 0.02  # of linear light, over which the slope of the sRGB curve is taken; a typical error after restoration
DISTANCES = (4, 8, 16, 32, 64)  # pixels at which light around dark pixels is compared
TRIMMED = 0.005  # share of pixels beyond either end of a scene's range of depths


class RadialSpectrum(NamedTuple):
    """Power spectral density of pictures, averaged over direction, channels and pictures."""

    frequency: Tensor
    """(F,) geometric middle of each bin in cycles per pixel."""
    density: Tensor
    """(F,) variance per square cycle per pixel; NaN where no picture has a frequency."""


def measured_statistics(
    images: Sequence[Tensor], depths: Sequence[Tensor] | None = None, source: str = "measured"
) -> SceneStatistics:
    """Measure the statistics of scenes from pictures and, if given, their depth maps.

    The spectrum is fitted over the frequencies that a picture holds at least four periods of: a straight line through
    the logarithm of the density gives the exponent, and the knee is where the integral of the spectrum equals the
    variance.

    Args:
        images: pictures encoded in sRGB, (C, H, W) each with 1 or 3 channels, in [0, 1]. At least 32 pixels a side.
        depths: depth in metres of each picture, (1, H, W); ``inf`` is allowed, unknown depths are zero or NaN.
            Default: all depths alike.
        source: note on the origin of the numbers.

    Returns:
        Mean and variance over all pixels of a picture, averaged over pictures and channels, the light around dark
        pixels, and the distribution of depth over each scene's own range of dioptres.

    Raises:
        TypeError: if an image or a depth map is not a floating-point tensor.
        ValueError: if there are no images, one is too small or has no contrast, the number of depth maps differs, or a
            scene lies at one depth.

    Source: Welch, IEEE Trans. Audio Electroacoustics 15(2), 70 (1967), for averaged windowed periodograms.

    Example:
        >>> noise = torch.rand(2, 1, 64, 64, generator=torch.Generator().manual_seed(0))
        >>> found = measured_statistics(list(noise.cumsum(2).cumsum(3) / 4096))
        >>> found.exponent > 2
        True
    """
    _check_pictures(images, depths)
    light = [linear_light(image) for image in images]
    mean = float(torch.stack([each.mean() for each in light]).mean())
    variance = float(torch.stack([each.var((-2, -1), correction=0).mean() for each in light]).mean())
    if not variance > 0:
        raise ValueError(f"images must have contrast, got {len(images)} without any")
    exponent, knee = fitted_power_law(radial_spectrum(light), variance)
    shade, shade_size = fitted_shade(light)
    shares = (1.0,) if depths is None else depth_shares(depths)
    return SceneStatistics(exponent, knee, mean, math.sqrt(variance), shade, shade_size, shares, source)


def linear_light(image: Tensor) -> Tensor:
    """Decode a picture from sRGB to linear light in float64."""
    return rgb_to_linear_rgb(image.double().expand(3, -1, -1)[None])[0]


def radial_spectrum(light: Sequence[Tensor]) -> RadialSpectrum:
    """Return the power spectrum of pictures, by periodograms with a Hann window, which keeps edges from leaking.

    Args:
        light: (C, H, W) each, linear light.

    Returns:
        The spectrum from 4 periods in the smallest side of the largest picture to half a cycle per pixel.
    """
    side = max(min(each.shape[-2:]) for each in light)
    edges = torch.logspace(math.log10(LOWEST / side), math.log10(0.5), BINS + 1, dtype=torch.float64)
    totals, counts = torch.zeros(BINS, dtype=torch.float64), torch.zeros(BINS, dtype=torch.float64)
    for each in light:
        frequency, density = _periodogram(each.double())
        held = (frequency >= max(LOWEST / min(each.shape[-2:]), float(edges[0]))) & (frequency < 0.5)
        index = torch.bucketize(frequency[held], edges, right=True).clamp(1, BINS) - 1
        number = torch.bincount(index, minlength=BINS)
        mean = torch.bincount(index, density[held], minlength=BINS) / number
        totals += mean.nan_to_num()
        counts += number > 0
    return RadialSpectrum((edges[1:] * edges[:-1]).sqrt(), totals / counts)


def _periodogram(light: Tensor) -> tuple[Tensor, Tensor]:
    """Return frequencies and power spectral density of a picture, each (H, W), averaged over channels."""
    rows, columns = light.shape[-2:]
    window = torch.hann_window(rows, dtype=torch.float64)[:, None] * torch.hann_window(columns, dtype=torch.float64)
    varying = light - (light * window).sum((-2, -1), keepdim=True) / window.sum()
    spectrum = torch.fft.fft2(varying * window)
    density = (spectrum.real.square() + spectrum.imag.square()).mean(0) / window.square().sum()
    down, across = (torch.fft.fftfreq(side, dtype=torch.float64) for side in (rows, columns))
    return torch.hypot(down[:, None], across), density


def fitted_power_law(spectrum: RadialSpectrum, variance: float) -> tuple[float, float]:
    """Fit a power law to a spectrum and return its exponent and knee; its integral is the variance.

    For each knee the exponent is fitted by least squares in logarithms. A smaller knee adds power at low frequencies;
    the one that adds up to the variance is found by bisection.

    Args:
        spectrum: measured density.
        variance: of the light.

    Returns:
        Exponent, and knee in cycles per pixel between 1/65536 and 1/4.
    """
    known = (spectrum.density > 0) & spectrum.density.isfinite()
    squared = spectrum.frequency[known].square().numpy()
    logarithm = spectrum.density[known].log().numpy()

    def fit(log_knee: float) -> tuple[float, float]:
        knee = math.exp(log_knee)
        slope, level = np.polyfit(np.log(squared + knee**2), logarithm, 1)
        return max(-2 * float(slope), 1e-3), math.exp(level)

    def excess(log_knee: float) -> float:
        exponent, level = fit(log_knee)
        whole = SceneStatistics(exponent, math.exp(log_knee), 1.0, 1.0)
        unit = float(whole.spectrum(torch.zeros((), dtype=torch.float64))) * math.exp(log_knee * exponent)
        return level / unit - variance

    low, high = math.log(2.0**-16), math.log(0.25)
    for _ in range(60):
        middle = (low + high) / 2
        low, high = (middle, high) if excess(middle) > 0 else (low, middle)
    return fit((low + high) / 2)[0], math.exp((low + high) / 2)


def fitted_shade(light: Sequence[Tensor]) -> tuple[float, float]:
    """Return ``shade`` and ``shade_size`` of pictures, see :meth:`SceneStatistics.light_around`.

    The light around is measured along rows and columns, up to a quarter of the smaller side of a picture.

    Args:
        light: (C, H, W) each, linear light.

    Returns:
        Fraction of the mean of light, at most 1, and distance in pixels.
    """
    around: dict[int, list[float]] = {0: [], **{distance: [] for distance in DISTANCES}}
    for each in light:
        counts = _squared_slope(each)
        for distance, found in around.items():
            if 4 * distance <= min(each.shape[-2:]):
                found.append(_light_at(distance, counts, each))
    means = {distance: sum(found) / len(found) for distance, found in around.items() if found}
    shade = min(means.pop(0), 1.0)
    sizes = np.geomspace(0.5, 4096, 2000)
    model = 1 - (1 - shade) * np.exp(-((np.array(list(means))[:, None] / sizes) ** 0.75))
    misfit = ((model - np.array(list(means.values()))[:, None]) ** 2).sum(0)
    return shade, float(sizes[misfit.argmin()])


def _squared_slope(light: Tensor) -> Tensor:
    ends = [linear_rgb_to_rgb((light + change).expand(3, -1, -1)[None].clamp(0, 1))[0] for change in (ERROR, -ERROR)]
    return ((ends[0] - ends[1]) / (2 * ERROR)).square()


def _light_at(distance: int, counts: Tensor, light: Tensor) -> float:
    """Return the light at a distance from pixels weighted by ``counts``, as a fraction of the mean of light."""
    ratios = []
    for a, x in ((counts, light), (counts.mT, light.mT)):
        side = a.shape[-1] - distance
        for first, second in ((a[..., :side], x[..., distance:]), (a[..., distance:], x[..., :side])):
            ratios.append((first * second).mean((-2, -1)) / (first.mean((-2, -1)) * second.mean((-2, -1))))
    return float(torch.stack(ratios).nan_to_num(1.0).mean())


def depth_shares(depths: Sequence[Tensor], parts: int = DEPTH_PARTS) -> tuple[float, ...]:
    """Return the distribution of depth over each scene's own range of dioptres, averaged over scenes.

    The range of a scene leaves out half a percent of its known pixels at either end, which count as its ends.

    Args:
        depths: (1, H, W) metres each; unknown depths are zero or NaN.
        parts: number of equally wide parts of the range.

    Returns:
        Share of pixels in each part, from the farthest to the nearest.

    Example:
        >>> depth_shares([torch.tensor([[[1.0, 2.0, 4.0, 4.0, 0.0]]])], parts=2)
        (0.75, 0.25)
    """
    total = np.zeros(parts)
    for depth in depths:
        dioptres = depth[depth > 0].double().reciprocal().numpy()
        far, near = np.quantile(dioptres, (TRIMMED, 1 - TRIMMED), method="nearest") if len(dioptres) else (0.0, 0.0)
        if not near > far:
            raise ValueError(f"a scene must have a range of depths, got one of {float(near):.4g} dioptres throughout")
        count, _ = np.histogram(((dioptres - far) / (near - far)).clip(0, 1), parts, (0, 1))
        total += count / count.sum()
    return tuple((total / len(depths)).tolist())


def _check_pictures(images: Sequence[Tensor], depths: Sequence[Tensor] | None) -> None:
    if not len(images):
        raise ValueError("images must be at least one picture, got none")
    for image in images:
        check_float_tensor("image", image, 3, "(C, H, W)")
        if image.shape[0] not in (1, 3) or min(image.shape[1:]) < 32:
            raise ValueError(f"images must be (1 or 3, H, W) of at least 32 pixels a side, got {tuple(image.shape)}")
    if depths is None:
        return
    if len(depths) != len(images):
        raise ValueError(f"depths must be one map for each of the {len(images)} images, got {len(depths)}")
    for image, depth in zip(images, depths, strict=True):
        check_float_tensor("depth", depth, 3, "(1, H, W)")
        if depth.shape[1:] != image.shape[1:]:
            raise ValueError(
                f"depth must have the size of its image, {tuple(image.shape[1:])}, got {tuple(depth.shape[1:])}"
            )
