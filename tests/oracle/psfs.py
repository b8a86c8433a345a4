"""Point spread functions: thin lens, Fraunhofer diffraction, sensor pixels, colour channels, dwell times."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

Array = np.ndarray
REFERENCE = 530e-9  # m
RGB = (610e-9, 530e-9, 470e-9)  # m; Wu et al., PhaseCam3D, ICCP 2019
PAPER_SIDES = (31, 27, 23)  # samples of the published transform in red, green and blue
CELL_ERROR, PIXEL_ERROR = 1e-10, 1e-9  # of a wave's mean over a mask pixel, of a ripple's over a sensor pixel


def defocus(depth: Array, radius: float, focus: float) -> Array:
    r"""Return psi: the curvature of a point's wave in the pupil, less that of a point in focus.

    A point at z is farther from the pupil's edge than from its middle by :math:`R^2 / 2z`, and so
    :math:`\psi = 2\pi / \lambda_0 \, (R^2 / 2z - R^2 / 2z_f)`. Source: Goodman, Fourier Optics, 6.4.
    """
    return 2 * np.pi / REFERENCE * (radius**2 / (2 * np.asarray(depth, float)) - radius**2 / (2 * focus))


def image_distance(focal_length: float, focus: float) -> float:
    """Return s' of the thin lens, 1/f = 1/z_f + 1/s'."""
    return 1 / (1 / focal_length - 1 / focus)


def fused_silica(wavelength: float) -> float:
    """Return the refractive index of fused silica at 20 degrees. Source: Malitson, JOSA 55, 1205 (1965)."""
    square = (wavelength * 1e6) ** 2
    terms = ((0.6961663, 0.0684043), (0.4079426, 0.1162414), (0.8974794, 9.896161))
    return math.sqrt(1 + sum(b * square / (square - c**2) for b, c in terms))


def gauss_points(half_range: float, error: float) -> tuple[Array, Array]:
    r"""Return Gauss-Legendre points on [-1/2, 1/2] and weights of sum one that average waves to within an error.

    Of :math:`e^{ibt}` on [-1, 1], with b up to ``half_range``, n points give the mean to within
    :math:`b^{2n} \, 2^{2n} (n!)^4 / ((2n + 1) ((2n)!)^3)`. Source: Abramowitz and Stegun, 25.4.29.
    """

    def bound(n: int) -> float:
        factorials = 4 * math.lgamma(n + 1) - 3 * math.lgamma(2 * n + 1) - math.log(2 * n + 1)
        return math.exp(2 * n * math.log(2 * max(half_range, 1e-9)) + factorials)

    n = 1
    while bound(n) > error:
        n += 1
    points, weights = np.polynomial.legendre.leggauss(n)
    return points / 2, weights / 2


def square_points(half_range: float, error: float) -> tuple[Array, Array, Array]:
    """Return x, y and weights of Gauss-Legendre points in a unit square, see :func:`gauss_points`."""
    line, weights = gauss_points(half_range, error)
    x, y = np.meshgrid(line, line)
    return x.ravel(), y.ravel(), np.outer(weights, weights).ravel()


def disc(cells: int, pitch: float) -> Array:
    """Return the paper's binary aperture: 1 in cells with their centre in the unit circle, 317 of 23x23."""
    centre = (np.arange(cells) - (cells - 1) / 2) * pitch
    return (centre[:, None] ** 2 + centre**2 <= 1 + 1e-9).astype(float)


def psfs(
    heights: Array,
    shares: Sequence[float],
    psi: Sequence[float],
    wavelength: float,
    window: int,
    pixel: float,
    *,
    index: float = 1.5,
    pitch: float = 0.1,
    aperture: Array | None = None,
    errors: tuple[float, float] = (CELL_ERROR, PIXEL_ERROR),
) -> Array:
    r"""Return (D, P, P): the share of the light through the aperture that falls on each sensor pixel.

    .. math:: h(p) = \frac{\int_p \left| \int A \, e^{i \varphi(x, y)} e^{-2\pi i (u x + v y)} \, dx \, dy \right|^2
        du \, dv}{\int A^2 \, dx \, dy}, \qquad
        \varphi = \frac{2\pi (n - 1) h}{\lambda} + \psi \frac{\lambda_0}{\lambda} (x^2 + y^2)

    x and y are in pupil radii R, u and v in cycles a radius; a sensor pixel of the side a at the image distance s' has
    the side :math:`R a / (\lambda s')`. By Parseval the PSF over the whole plane sums to one. Averaged over masks shown
    one after another. Each mask pixel has one phase. Source: Goodman, Fourier Optics, 5.2.

    Args:
        heights: (K, N, N) metres.
        shares: of the exposure for each mask.
        psi: for each PSF.
        wavelength: in metres.
        window: side P in pixels.
        pixel: R a / s' in metres.
        index: refractive index of the mask at this wavelength.
        pitch: of mask pixels, in pupil radii.
        aperture: amplitude (N, N). Default: :func:`disc`.
        errors: of the mean of one plane wave over a mask pixel, and of one ripple over a sensor pixel, along an axis.
            Of all light, with E of it in a window of s cycles a side, the first makes :math:`4 e s \sqrt{a E}` at most
            (Cauchy-Schwarz) and the second :math:`2 e s^2 a`, where a is the open area.
    """
    cells, step, r = heights.shape[-1], pixel / wavelength, window // 2
    open_ = disc(cells, pitch) if aperture is None else aperture
    row, column = np.nonzero(open_)
    edge = cells * pitch / 2
    bend = 2 * max(abs(p) for p in psi) * REFERENCE / wavelength * edge + 2 * np.pi * step * window / 2
    dx, dy, area = square_points(bend * pitch / 2, errors[0])
    x = ((column - (cells - 1) / 2)[:, None] + dx).ravel() * pitch
    y = ((row - (cells - 1) / 2)[:, None] + dy).ravel() * pitch
    # Two points of the pupil are at most 2 edge apart along an axis: so fast are a PSF's ripples.
    du, dv, inside = square_points(2 * np.pi * 2 * edge * step / 2, errors[1])
    amplitude = np.repeat(open_[row, column], len(area)) * np.tile(area, len(row)) * pitch**2
    waves = []
    for height in heights:
        delay = np.repeat(2 * np.pi * (index - 1) / wavelength * height[row, column], len(area))
        waves += [amplitude * np.exp(1j * (delay + p * REFERENCE / wavelength * (x**2 + y**2))) for p in psi]
    waves = np.stack(waves, 1)
    within = np.exp(-2j * np.pi * step * (du[:, None] * x + dv[:, None] * y))
    out = np.zeros((len(heights), len(psi), window, window))
    for i in range(window):
        for j in range(window):
            there = np.exp(-2j * np.pi * step * ((j - r) * x + (i - r) * y))
            intensity = np.abs(within @ (there[:, None] * waves)) ** 2
            out[..., i, j] = (inside @ intensity * step**2).reshape(len(heights), len(psi))
    light = np.sum(open_**2) * pitch**2
    return np.einsum("k,kdij->dij", np.asarray(shares), out) / light


def channels(at_wavelengths: Sequence[Array], response: Array) -> Array:
    r"""Return the PSFs of colour channels, (D, C, P, P), from those of wavelengths, (D, P, P) each.

    .. math:: h_c = \sum_\lambda s_c(\lambda) h_\lambda \Big/ \sum_\lambda s_c(\lambda)
    """
    mixed = [sum(s * psf for s, psf in zip(row, at_wavelengths, strict=True)) / sum(row) for row in response]
    return np.stack(mixed, 1)


def paper_psfs(heights: Array, psi: Sequence[float]) -> Array:
    r"""Return the PSFs of the published discretisation, (D, 3, 23, 23), by its FFT written as a sum over the pupil.

    .. math:: h(p) = \frac{1}{M^2 \sum A} \Big| \sum_{m} A_m e^{i\varphi_m} e^{-2\pi i \, p \cdot m / M} \Big|^2

    with M of 31, 27 and 23, p from -11 to 11 along each axis, an index of 1.5, equal shares of the masks, point
    samples, and no renormalising. Source: Wu et al., PhaseCam3D, ICCP 2019; Shah et al., TiDy-PSFs, ICCV 2023.
    """
    at = np.arange(-11, 12)
    m2, m1 = (axis.ravel() for axis in np.meshgrid(at, at, indexing="ij"))
    rho2 = (m1**2 + m2**2) / 100
    open_ = (rho2 <= 1).astype(float)
    out = np.zeros((len(psi), 3, 23, 23))
    for c, (wavelength, side) in enumerate(zip(RGB, PAPER_SIDES, strict=True)):
        wave = np.exp(-2j * np.pi / side * (np.outer(m1, m1) + np.outer(m2, m2)))
        for d, p in enumerate(psi):
            for height in heights:
                phase = 2 * np.pi * 0.5 * height.ravel() / wavelength + p * rho2 * REFERENCE / wavelength
                light = np.abs(wave @ (open_ * np.exp(1j * phase))) ** 2 / (side**2 * open_.sum())
                out[d, c] += light.reshape(23, 23) / len(heights)
    return out


def switching_shares(masks: int, exposure: float, swap: float, cyclic: bool = False) -> tuple[list[float], list[float]]:
    """Return the shares of the exposure T of masks, (T - S t) / (K T), and of the swaps between them, t / T.

    The first mask is set before the shutter opens, so there are S = K - 1 swaps. A cyclic exposure swaps back to it at
    the end: S = K. Source: Shah et al., TiDy-PSFs, ICCV 2023, "Modeling State Switching in SLMs".
    """
    swaps = masks if cyclic else masks - 1
    return [(exposure - swaps * swap) / (masks * exposure)] * masks, [swap / exposure] * swaps
