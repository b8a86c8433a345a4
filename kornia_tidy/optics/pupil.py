"""The pupil: the aperture on its grid, and the field of light behind a mask in it."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Pupil:
    """The aperture on a grid of square cells, a whole number of them for each mask pixel.

    Args:
        amplitude: (n, n) in [0, 1].
        cell_pitch: side of a cell in pupil radii.

    Example:
        >>> from kornia_tidy.optics.aperture import circular_aperture
        >>> pupil = Pupil(circular_aperture(23), 0.1)
        >>> round(pupil.light, 2), round(pupil.extent, 2)
        (3.17, 1.05)
    """

    amplitude: Tensor
    cell_pitch: float
    light: float = field(init=False)
    """Light it lets through, in units of squared amplitude times pupil radii squared."""
    extent: float = field(init=False)
    """Half width of the open part in pupil radii; twice it bounds the frequencies in a PSF."""
    max_rho2: float = field(init=False)
    """Largest squared distance of an open cell from the axis; it bounds how fast a PSF changes with defocus."""

    def __post_init__(self) -> None:
        size = self.amplitude.shape[-1]
        cells = torch.nonzero(self.amplitude) - (size - 1) / 2
        object.__setattr__(self, "light", float(self.amplitude.double().square().sum()) * self.cell_pitch**2)
        object.__setattr__(self, "extent", (float(cells.abs().max()) + 0.5) * self.cell_pitch)
        object.__setattr__(self, "max_rho2", float(cells.square().sum(1).max()) * self.cell_pitch**2)


def pupil_field(phase: Tensor, aperture: Tensor, dispersion: float) -> Tensor:
    """Return the complex field behind the mask at one wavelength.

    Args:
        phase: radians at 530 nm, (K, N, N), float32 or float64.
        aperture: amplitude on the same grid or one with a whole number of cells for each mask pixel, (sN, sN).
        dispersion: factor that takes the phase at 530 nm to the wavelength.

    Returns:
        (K, sN, sN) complex.

    Example:
        >>> pupil_field(torch.zeros(1, 2, 2), torch.ones(4, 4), 1.0).shape
        torch.Size([1, 4, 4])
    """
    cells = aperture.shape[-1] // phase.shape[-1]
    angle = phase * dispersion
    amplitude = aperture.to(angle)
    cosine, sine = angle.cos(), angle.sin()
    if cells > 1:
        cosine, sine = (x.repeat_interleave(cells, -1).repeat_interleave(cells, -2) for x in (cosine, sine))
    return torch.complex(amplitude * cosine, amplitude * sine)
