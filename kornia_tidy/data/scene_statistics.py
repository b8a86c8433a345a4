"""Statistics of scenes in linear light: power spectrum, mean, standard deviation, and distribution of depth."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from kornia_tidy.checks import check_positive


@dataclass(frozen=True)
class SceneStatistics:
    r"""Statistics of scenes in linear light, full scale 1.

    The power spectrum is isotropic, with the frequency f in cycles per pixel:

    .. math:: S(f) = s \, (f^2 + f_0^2)^{-\alpha / 2}, \qquad
              \int_{-1/2}^{1/2} \int_{-1/2}^{1/2} S \, df_x \, df_y = \sigma^2

    Args:
        exponent: :math:`\alpha`, positive.
        knee: :math:`f_0` in cycles per pixel, positive: below it the spectrum is flat.
        mean: mean of light.
        spread: standard deviation :math:`\sigma` of light within a picture.
        shade: mean light of the pixels in which errors show, as a fraction of the mean of light, see
            :meth:`light_around`. 1 counts errors in linear light; less counts them in sRGB, which shows errors of dark
            pixels.
        shade_size: distance in pixels over which the light around such pixels rises to the mean.
        depths: share of pixels in each of several equally wide parts of a scene's range of dioptres, from the farthest
            to the nearest. Default: all depths alike.
        source: where the numbers come from.

    Raises:
        ValueError: if a number is not positive, or the shares of depth are negative or do not add up to one.

    Source: Field, J. Opt. Soc. Am. A 4(12), 2379 (1987), for a power law as the spectrum of natural scenes.

    Example:
        >>> scenes = SceneStatistics(exponent=2.0, knee=1 / 64, mean=0.3, spread=0.2)
        >>> round(float(scenes.cell_power(128).sum()), 6)
        0.04
    """

    exponent: float
    knee: float
    mean: float
    spread: float
    shade: float = 1.0
    shade_size: float = 64.0
    depths: tuple[float, ...] = (1.0,)
    source: str = ""
    level: float = field(init=False, repr=False)

    def __post_init__(self) -> None:
        for name in ("exponent", "knee", "mean", "spread", "shade", "shade_size"):
            check_positive(name, getattr(self, name))
        if not self.depths or min(self.depths) < 0 or abs(sum(self.depths) - 1) > 1e-3:
            raise ValueError(f"depths must be shares of pixels that add up to 1, got {self.depths}")
        object.__setattr__(self, "level", self.spread**2 / _integral(self.exponent, self.knee))

    def spectrum(self, frequency: Tensor) -> Tensor:
        """Return the power spectral density of light at spatial frequencies.

        Args:
            frequency: magnitude of the frequency in cycles per pixel, any shape.

        Returns:
            Variance per square cycle per pixel, same shape and dtype. For an image of N pixels, N times this is the
            mean square modulus of a coefficient of its discrete Fourier transform.

        Example:
            >>> scenes = SceneStatistics(exponent=2.0, knee=0.01, mean=0.3, spread=0.2)
            >>> ratio = scenes.spectrum(torch.tensor(0.1)) / scenes.spectrum(torch.tensor(0.2))
            >>> round(ratio.item(), 2)
            3.97
        """
        return self.level * (frequency.square() + self.knee**2) ** (-self.exponent / 2)

    def cell_power(self, size: int) -> Tensor:
        """Return the variance of light in each cell of a grid of frequencies, that of a square image's transform.

        The zero frequency gets the rest of the total, since the spectrum may have its knee within one
        cell.

        Args:
            size: side N of the image in pixels.

        Returns:
            (N, N // 2 + 1) float64, for the half spectrum of a real transform. Columns of two frequencies
            hold the variance of both, so that the sum is the variance of light.
        """
        down, across = torch.fft.fftfreq(size, dtype=torch.float64), torch.fft.rfftfreq(size, dtype=torch.float64)
        power = self.spectrum(torch.hypot(down[:, None], across)) / size**2
        power[:, 1 : (size + 1) // 2] *= 2
        power[0, 0] = 0
        power[0, 0] = (self.spread**2 - power.sum()).clamp(min=0)
        return power

    def light_around(self, distance: Tensor) -> Tensor:
        r"""Return the mean light at a distance from pixels in which errors show, as a fraction of the mean of light.

        .. math:: w(r) = \frac{\langle a(x_p) \, x_{p+r} \rangle}{\langle a \rangle \langle x \rangle}
                  \approx 1 - (1 - w_0) \, e^{-(r / r_0)^{3/4}}

        a is the squared slope of the sRGB curve, the weight of an error in linear light. It is large in
        dark pixels, and light near them is also dim. Light from far away, as in the halo of a wide PSF, therefore
        counts more than light from neighbours.

        Args:
            distance: r in pixels, any shape.

        Returns:
            Fraction of the mean of light, same shape and dtype; ``shade`` at 0, 1 at infinity.

        Example:
            >>> PHOTOGRAPHS.light_around(torch.tensor([0.0, 8.0, 64.0])).round(decimals=2)
            tensor([0.2900, 0.4100, 0.7100])
        """
        return 1 - (1 - self.shade) * torch.exp(-((distance / self.shade_size) ** 0.75))

    def depth_weights(self, defocus: Tensor) -> Tensor:
        """Return the share of pixels nearest to each node of defocus, where the nodes span the range of the scenes.

        Args:
            defocus: (D,) ascending nodes in radians, from the farthest depth to the nearest.

        Returns:
            (D,) in the dtype of ``defocus``, of sum one.

        Example:
            >>> scenes = SceneStatistics(exponent=2.0, knee=0.01, mean=0.3, spread=0.2, depths=(0.75, 0.25))
            >>> scenes.depth_weights(torch.tensor([-10.0, 0.0, 10.0]))
            tensor([0.3750, 0.5000, 0.1250])
        """
        if len(defocus) == 1:
            return torch.ones_like(defocus)
        middles = (defocus[1:] + defocus[:-1]) / 2
        edges = torch.cat([defocus[:1], middles, defocus[-1:]])
        edges = (edges - edges[0]) / (edges[-1] - edges[0])
        shares = edges.new_tensor(self.depths)
        ends = torch.arange(len(shares) + 1, device=edges.device, dtype=edges.dtype) / len(shares)
        overlap = torch.minimum(edges[1:, None], ends[1:]) - torch.maximum(edges[:-1, None], ends[:-1])
        return (overlap.clamp(min=0) * (shares / shares.sum())).sum(1) * len(shares)


def _integral(exponent: float, knee: float) -> float:
    r"""Return the integral of (f² + f0²)^(-α/2) over the square of frequencies up to 1/2 in x and y.

    Along a radius it is elementary; over the eighth of a turn that the square repeats it is summed by Gauss-Legendre.
    """
    nodes, weights = np.polynomial.legendre.leggauss(16)
    angle = (nodes + 1) * math.pi / 8
    squared = (0.5 / np.cos(angle)) ** 2
    power = 1 - exponent / 2
    if abs(power) < 1e-9:
        radial = 0.5 * np.log1p(squared / knee**2)
    else:
        radial = 0.5 * ((squared + knee**2) ** power - knee ** (2 * power)) / power
    return float(8 * (weights * radial).sum() * math.pi / 8)


PHOTOGRAPHS = SceneStatistics(
    exponent=2.76,
    knee=1 / 344,
    mean=0.226,
    spread=0.213,
    shade=0.293,
    shade_size=75.8,
    depths=(0.284, 0.148, 0.137, 0.135, 0.106, 0.093, 0.059, 0.038),
    source="18 photographs and renderings with depth (Middlebury, 7-Scenes, TUM, NYU, Flying Things, ...), the middle "
    "512 pixels; python -m tests.benchmarks.scene_statistics, 2026-11-22",
)
"""Statistics of photographs of some 500 pixels a side, whose spectrum is within a fifth of this power law. On 13 other
scenes an exponent of 2.9, a knee near 1/256, a mean of 0.29 and a spread of 0.23 were measured."""
