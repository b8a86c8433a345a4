"""The work and the memory of a PSF bank, by formula."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import torch

from kornia_tidy.fidelity import Fidelity
from kornia_tidy.optics.quadrature import gauss_legendre_order
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH
from kornia_tidy.psf.energies import energy_operations
from kornia_tidy.psf.pupil import Pupil

_points = cache(gauss_legendre_order)


@dataclass(frozen=True)
class BankGeometry:
    """What the cost of a PSF bank depends on, beside the fidelity.

    Args:
        states: masks shown during the exposure, K.
        pupil: the aperture.
        wavelengths: in metres.
        pixel_step: a sensor pixel in the pupil, see :func:`kornia_tidy.psf.exact.exact_psf_bank`.
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

    For each layer and wavelength as many as :func:`~kornia_tidy.psf.energies.energy_operations` says, of its two
    ways the one with fewer.

    Example:
        >>> geometry = BankGeometry(5, Pupil(torch.ones(23, 23), 0.1), (530e-9,), 2e-7)
        >>> f"{bank_operations(geometry, Fidelity(window=65), 21):.1e}"
        '3.9e+08'
    """
    return (2 if fidelity.double else 1) * layers * sum(min(ways) for ways in _operations(geometry, fidelity))


def _operations(geometry: BankGeometry, fidelity: Fidelity) -> list[tuple[int, int]]:
    """Of a layer, for each wavelength: by either way."""
    cells, window = geometry.pupil.amplitude.shape[-1], window_side(fidelity)
    orders = (side // window for side in geometry.samples(fidelity))
    return [energy_operations(geometry.states, window, order, cells) for order in orders]


def memory_bytes(geometry: BankGeometry, channels: int, fidelity: Fidelity, layers: int, rendering: int) -> int:
    """Return the peak memory of a capture without gradients beyond the image: of the bank or the renderer, whichever.

    The bank holds its PSFs, and its kernels four times: as remembered, in one piece, and as real matrices.

    Args:
        geometry: of the bank.
        channels: of the image.
        fidelity: its window, points and precision count.
        layers: PSFs held.
        rendering: what the renderer takes, see :func:`kornia_tidy.planning.rendering_cost.rendering_work`.
    """
    real = 8 if fidelity.double else 4
    psfs = real * layers * channels * window_side(fidelity) ** 2
    kernels = 2 * real * layers * max(geometry.samples(fidelity)) * geometry.pupil.amplitude.shape[-1]
    return psfs + max(4 * kernels, rendering)


def window_side(fidelity: Fidelity) -> int:
    """Return the fixed window of a fidelity.

    Raises:
        ValueError: if it has none.
    """
    if fidelity.window is None:
        raise ValueError(f"a fidelity to plan with needs a fixed window, got window=None of {fidelity.name!r}")
    return fidelity.window
