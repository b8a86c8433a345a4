r"""Geometric-optics PSFs: far out of focus, a lens without a mask images a point as its aperture.

A ray through the pupil at :math:`x` (in pupil radii) meets the sensor at :math:`\psi x \lambda_0 / (\pi s)` pixels: the
gradient of the defocus phase :math:`\psi \rho^2`. So the PSF is the aperture's transmission, scaled, and integrated
over each pixel. Diffraction is left out.

Source: Goodman, Introduction to Fourier Optics, 6.4.4 (the geometrical limit of a defocused system).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH


def blur_radius(defocus: float, step: float) -> float:
    r"""Return the radius of the defocus disc in pixels, by rays: :math:`|\psi| \lambda_0 / (\pi s)`.

    Args:
        defocus: radians at the pupil edge at 530 nm.
        step: s, a sensor pixel seen from the pupil in metres, see :func:`kornia_tidy.psf.exact.exact_psf_bank`.

    Example:
        >>> round(blur_radius(-517.0, 1.625e-6), 1)  # 50 mm f/1.8 focused at 2 m, a point at 21 m, pixels of 6 um
        53.7
    """
    return abs(defocus) * REFERENCE_WAVELENGTH / (math.pi * step)


def geometric_psfs(transmission: Tensor, pitch: float, defocus: Sequence[float], step: float, window: int) -> Tensor:
    """Return geometric-optics PSFs: the image of the aperture on the sensor's pixels, the same at all wavelengths.

    Args:
        transmission: share of the light that passes each cell of the aperture, (N, N) in [0, 1]: that of a ``Pupil``.
        pitch: side of a cell in pupil radii.
        defocus: radians at the pupil edge at 530 nm, not 0.
        step: a sensor pixel seen from the pupil in metres.
        window: pixels along a side, odd.

    Returns:
        The share of the light in each pixel, (D, P, P) float64, with sum one where the window holds the whole image.

    Convention:
        - Axes are (y, x). For positive defocus, nearer than focus, the image of the aperture is upright.

    Example:
        >>> from kornia_tidy.optics.aperture import circular_aperture
        >>> psf = geometric_psfs(circular_aperture(23), 0.1, [-517.0], 1.625e-6, 119)[0]
        >>> round(float(psf.sum()), 6), int((psf > 0).any(0).sum())
        (1.0, 113)
    """
    cells = transmission.shape[-1]
    edges = (torch.arange(cells + 1, dtype=torch.float64, device=transmission.device) - cells / 2) * pitch
    pixels = torch.arange(window, dtype=torch.float64, device=transmission.device)[:, None] - window // 2
    light = transmission.double()
    light = light / light.sum()
    psfs = []
    for psi in defocus:
        scaled = edges * (psi * REFERENCE_WAVELENGTH / (math.pi * step))
        begin, end = torch.minimum(scaled[:-1], scaled[1:]), torch.maximum(scaled[:-1], scaled[1:])
        overlap = (torch.minimum(end, pixels + 0.5) - torch.maximum(begin, pixels - 0.5)).clamp(min=0) / (end - begin)
        psfs.append(overlap @ light @ overlap.T)
    return torch.stack(psfs)
