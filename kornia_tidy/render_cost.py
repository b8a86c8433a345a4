"""What a capture costs: floating-point operations and memory of the PSF bank and of the rendering, by formula.

Operations are real additions and multiplications, in float64 counted twice. Matrix products and Fourier transforms of
this size run at like speed (17 and 13 billion a second in float32 on a core of a Xeon), so they are added up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import torch

from kornia_tidy.fidelity import Fidelity
from kornia_tidy.optics.propagation import gauss_legendre_order
from kornia_tidy.optics.pupil import Pupil
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH
from kornia_tidy.scene.convolution import next_fast_size, padded_size

_points = cache(gauss_legendre_order)


@dataclass(frozen=True)
class BankGeometry:
    """What the cost of a PSF bank depends on, beside the fidelity.

    Args:
        states: masks shown during the exposure, K.
        pupil: the aperture.
        wavelengths: in metres.
        pixel_step: a sensor pixel in the pupil, see :func:`kornia_tidy.optics.exact.exact_psf_bank`.
    """

    states: int
    pupil: Pupil
    wavelengths: tuple[float, ...]
    pixel_step: float

    def samples(self, fidelity: Fidelity) -> list[int]:
        """Return the samples along a side of the field on the sensor, for each wavelength."""
        phases = (2 * math.pi * self.pupil.extent * self.pixel_step / wavelength for wavelength in self.wavelengths)
        return [window_side(fidelity) * _points(phase, fidelity.pixel_tolerance) for phase in phases]

    @property
    def bandwidth(self) -> float:
        """Fastest change of a PSF with defocus: the pupil's largest squared radius, at the shortest wavelength."""
        cells = self.pupil.amplitude.shape[-1]
        edge = ((torch.arange(cells, dtype=torch.float64) - (cells - 1) / 2).abs() + 0.5) * self.pupil.cell_pitch
        squared = (edge[:, None] ** 2 + edge**2)[self.pupil.amplitude.cpu() > 0]
        return float(squared.max()) * REFERENCE_WAVELENGTH / min(self.wavelengths)


def bank_operations(geometry: BankGeometry, fidelity: Fidelity, layers: int) -> float:
    r"""Return the operations of an exact PSF bank.

    .. math:: D K \sum_\lambda (8 U N^2 + 8 U^2 N + 4 U^2), \qquad U = q_\lambda P

    for D layers, K states, N cells of the pupil and q points a pixel along each side of a window P: two complex matrix
    products and the mean intensity.

    Example:
        >>> geometry = BankGeometry(5, Pupil(torch.ones(23, 23), 0.1), (530e-9,), 2e-7)
        >>> f"{bank_operations(geometry, Fidelity(window=65), 21):.1e}"
        '8.4e+08'
    """
    cells = geometry.pupil.amplitude.shape[-1]
    sides = geometry.samples(fidelity)
    each = sum(8 * side * cells**2 + 8 * side**2 * cells + 4 * side**2 for side in sides)
    return _weight(fidelity) * layers * geometry.states * each


def rendering_operations(shape: tuple[int, int, int, int], border: str, fidelity: Fidelity, layers: int) -> float:
    r"""Return the operations of the dense renderer.

    .. math:: (B C (1 + D) + C D) \cdot 2.5\, n \log_2 n + 7\, B C D\, n

    for D layers present and planes of n pixels, padded for the border and to a fast size: one transform for each image,
    one for each PSF, one back for each layer and image; a product of spectra and two choices a pixel.

    Args:
        shape: (B, C, H, W) of the image.
        border: see :mod:`kornia_tidy.scene.convolution`.
        fidelity: its window and precision count.
        layers: how many the scene holds.

    Example:
        >>> f"{rendering_operations((1, 3, 1024, 1024), 'reflect', Fidelity(window=65), 21):.1e}"
        '8.8e+09'
    """
    batch, channels, height, width = shape
    down, across = (next_fast_size(side) for side in padded_size(height, width, window_side(fidelity), border))
    pixels = down * across
    transform = 2.5 * pixels * math.log2(max(2, pixels))
    transforms = batch * channels * (1 + layers) + channels * layers
    return _weight(fidelity) * (transforms * transform + 7 * batch * channels * layers * pixels)


def memory_bytes(
    geometry: BankGeometry,
    shape: tuple[int, int, int, int],
    border: str,
    fidelity: Fidelity,
    layers: int,
) -> int:
    """Return the peak memory of a capture without gradients beyond the image: of the bank or the renderer, whichever.

    The bank holds its PSFs, and its kernels four times: as remembered, in one piece, and as real matrices. The renderer
    holds some sixteen planes of the padded image's size in all channels: two spectra and their product, the transforms'
    own copies, the sums and what is chosen from. Both are within a third of what was measured on a CPU.
    """
    batch, channels, height, width = shape
    real = 4 * _weight(fidelity)
    side = max(geometry.samples(fidelity))
    psfs = real * layers * channels * window_side(fidelity) ** 2
    kernels = 2 * real * layers * side * geometry.pupil.amplitude.shape[-1]
    down, across = (next_fast_size(side) for side in padded_size(height, width, window_side(fidelity), border))
    return int(psfs + max(4 * kernels, 16 * real * batch * channels * down * across))


def _weight(fidelity: Fidelity) -> int:
    return 2 if fidelity.double else 1


def window_side(fidelity: Fidelity) -> int:
    """Return the fixed window of a fidelity.

    Raises:
        ValueError: if it has none.
    """
    if fidelity.window is None:
        raise ValueError(f"a fidelity to plan with needs a fixed window, got window=None of {fidelity.name!r}")
    return fidelity.window
