r"""Fourier transform of scattered points to the light in the pixels of a sensor.

.. math:: I(p) = \int_p \Big| \sum_j c_j e^{-2\pi i (\nu_j X + \mu_j Y)} \Big|^2 dX \, dY

The points are spread on a small grid with a kernel of a few samples, transformed along either axis by a matrix, and the
kernel's transform is divided out: a nonuniform transform of type 1. Grid and samples lie evenly about their middles,
so that sums and differences of mirrored rows are transformed by real matrices, of even and odd rows apart for a quarter
of the period. The samples of the intensity lie denser than its bandwidth asks, so that the integral over a pixel is a
short sum of them.

Source: Barnett, Magland and af Klinteberg, SIAM J. Sci. Comput. 41(5) C479 (2019), for the transform; Kaiser's window
for the kernel and for the interpolation between samples.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from kornia_tidy.kernels.build import compiled
from kornia_tidy.kernels.scattered_ops import SOURCE, Points, Transform, scattered_light, scattered_light_by_torch
from kornia_tidy.mode import Mode, torch_mode

_SIGMA = 1.2  # period of the transform over the window: light beyond it folds back outside the used part
_DENSITY = 1.15  # samples of the intensity over those that its bandwidth needs
_DIM = 0.2  # power of the tolerance
_NODES = 96
_STEP = 0.25  # pixels in which the largest shift is counted


@dataclass(frozen=True, eq=False)
class Grid:
    """Grid of the transform, alike for both axes.

    Args:
        step: cycles per pixel from sample to sample.
        extent: samples M, odd; frequency zero is the middle one.
        width: samples that a point is spread on.
        kernel: the spreading kernel as a polynomial in 1 - x^2, with x from -1 to 1 over its width, (n,) float64.
        cosines: transform of sums of mirrored rows, (L / 2, (M + 1) / 2) float64, for a period of 2 L samples.
        sines: the same of differences.
        correction: one over the square of the kernel's transform at the N samples of the intensity, float64.
        spacing: pixels from sample to sample of the intensity; N, even, lie about the middle of the window.
        reach: samples to either side that the interpolation between samples takes.
        decay: of its window.
    """

    step: float
    extent: int
    width: int
    kernel: Tensor
    cosines: Tensor
    sines: Tensor
    correction: np.ndarray
    spacing: float
    reach: int
    decay: float

    def sums(self, window: int, shifts: Tensor, mirrored: bool = False) -> Tensor:
        """Return the sums over samples that give the light in pixels along an axis, (F, V, P, N).

        Args:
            window: P.
            shifts: of the light in the pixels, (F, V).
            mirrored: whether the samples are those of the light's mirror image.
        """
        if not bool(shifts.any()):
            return self._centred(window, mirrored).expand(*shifts.shape, -1, -1)
        found = torch.stack([self._shifted(window, tuple(row)) for row in shifts.tolist()])
        return found.flip(-1) if mirrored else found

    @lru_cache(maxsize=8)  # noqa: B019 (grids are remembered themselves)
    def _centred(self, window: int, mirrored: bool) -> Tensor:
        found = self._shifted(window, (0.0,))[0]
        return found.flip(-1) if mirrored else found

    def _shifted(self, window: int, shifts: tuple[float, ...]) -> Tensor:
        count = len(self.correction)
        at = np.arange(count) - (count - 1) / 2
        edges = np.arange(window + 1) - window / 2 - np.array(shifts)[:, None]
        within = _interpolant_integral(edges[..., None] / self.spacing - at, self.reach, self.decay)
        return torch.from_numpy(self.spacing * np.diff(within, axis=1) * self.correction)


@lru_cache(maxsize=32)
def scattered_grid(highest: float, window: int, tolerance: float, shift: float = 0.0) -> Grid:
    """Return the grid for points up to a frequency.

    Args:
        highest: modulus of a frequency along an axis in cycles per pixel.
        window: side P in pixels, odd.
        tolerance: error of the field, relative to the sum of the points' moduli.
        shift: of the light in pixels, at most.

    Example:
        >>> grid = scattered_grid(0.3, 9, 1e-3)
        >>> grid.extent, grid.cosines.shape, grid.sums(9, torch.zeros(2, 1)).shape
        (21, torch.Size([9, 11]), torch.Size([2, 1, 9, 28]))
    """
    span = max(2 * highest, 1e-3)
    width = max(3, math.ceil(-math.log10(tolerance) * _WIDTH))
    decay = 1 - 0.85 * math.log(tolerance)  # a pixel attenuates the spectrum's images too
    lit = 1 - tolerance**_DIM  # of the bandwidth: little light is at the highest frequencies, as overlaps of the stop
    reach = math.ceil(math.hypot(decay, math.pi) / (math.pi * (1 - lit / _DENSITY)))
    spacing = 1 / (2 * _DENSITY * span)
    half = math.ceil((window / 2 + math.ceil(shift / _STEP - 1e-9) * _STEP) / spacing) + reach
    quarter = math.ceil(_SIGMA * half / 2)
    step = 1 / (4 * quarter * spacing)
    extent = 2 * math.ceil((span / step + width) / 2) + 1
    at = np.abs(np.arange(2 * half) + 0.5 - half)
    correction = _spread_transform(at * spacing * step, width) ** -2.0
    turns = 2 * math.pi * spacing * step * (np.arange(quarter)[:, None] + 0.5) * np.arange(extent // 2 + 1)
    cosines, sines = torch.from_numpy(np.cos(turns)), torch.from_numpy(np.sin(turns))
    kernel = torch.from_numpy(_kernel(width))
    return Grid(step, extent, width, kernel, cosines, sines, correction, spacing, reach, decay)


def scattered_energies(
    waves: Tensor, weights: Tensor, points: Points, grid: Grid, rows: Tensor, columns: Tensor
) -> Tensor:
    """Return the light in each pixel, averaged over states, for each exposure and shift, (F, D, E, V, P, P).

    Args:
        waves: of each exposure, state and cell, (E, K, N) complex.
        weights: share of the exposure of each state, (K,).
        points: of F fields.
        grid: that they are spread on.
        rows: sums over samples for the pixels along y, (F, E, V, P, N).
        columns: the same along x.
    """
    transform = Transform(*(part.to(weights) for part in (grid.kernel, grid.cosines, grid.sines)))
    given = waves, weights, points, grid.width, transform, rows.to(weights), columns.to(weights)
    here = waves.device.type == "cpu" and not torch_mode() & Mode.TRACED
    if here and compiled(SOURCE, weights.dtype) is not None:
        return scattered_light(*given)
    return scattered_light_by_torch(*given)


_WIDTH = 1.0 / (1 - 1 / (2 * _SIGMA)) / 2 * 1.5


@lru_cache(maxsize=16)
def _kernel(width: int) -> np.ndarray:
    """Return Kaiser's window over [-1, 1] as a polynomial in 1 - x^2."""
    shape = math.pi * math.sqrt(max((width * (1 - 1 / (2 * _SIGMA))) ** 2 - 0.8, 0.25))
    series = np.polynomial.Chebyshev.interpolate(
        lambda u: np.i0(shape * np.sqrt(np.maximum(u, 0))) / np.i0(shape), width + 4, [0, 1]
    )
    return series.convert(kind=np.polynomial.Polynomial).coef


def _spread_transform(frequency: np.ndarray, width: int) -> np.ndarray:
    """Return the Fourier transform of the kernel, frequency in cycles per sample."""
    nodes, weights = np.polynomial.legendre.leggauss(_NODES)
    values = weights * np.polynomial.polynomial.polyval(1 - nodes**2, _kernel(width)) * width / 2
    return np.cos(math.pi * width * frequency[:, None] * nodes) @ values


@lru_cache(maxsize=16)
def _integral_table(reach: int, decay: float) -> np.ndarray:
    """Return the integral of the windowed sinc from 0 to steps of a thousandth of a sample."""
    nodes, weights = np.polynomial.legendre.leggauss(4)
    at = (np.arange(1000 * reach)[:, None] + (nodes + 1) / 2) / 1000
    window = np.i0(decay * np.sqrt(np.maximum(1 - (at / reach) ** 2, 0))) / np.i0(decay)
    return np.concatenate([[0.0], np.cumsum((np.sinc(at) * window) @ weights / 2000)])


def _interpolant_integral(at: np.ndarray, reach: int, decay: float) -> np.ndarray:
    """Return the integral of the interpolant between samples from 0 to ``at``, in samples."""
    table = _integral_table(reach, round(decay, 6))
    place = np.minimum(np.abs(at), reach) * 1000
    index = np.minimum(place.astype(int), len(table) - 2)
    part = place - index
    return np.sign(at) * (table[index] * (1 - part) + table[index + 1] * part)
