"""The pupil: the aperture on its grid, and the field of light behind a mask in it."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor
from torch.nn.functional import pad

from kornia_tidy.checks import check_values
from kornia_tidy.kernels.precision import has_float64
from kornia_tidy.masks.base import MASK_SPAN
from kornia_tidy.optics.aperture import circular_aperture, light_through


@dataclass(frozen=True, eq=False)
class Pupil:
    """The aperture on a grid of square cells, a whole number of them for each mask pixel.

    Args:
        amplitude: (n, n) in [0, 1], or an :class:`~kornia_tidy.optics.aperture.OpenArea`. Of a learnable aperture
            (n, n) or of one for each mask, (K, n, n): scaled to let a light of one through, unless a lens cuts it.
        cell_pitch: side of a cell in pupil radii.
        fill_factor: share of the area of each mask pixel that modulates, a square in its middle.
        light: that it lets through, in units of squared amplitude times pupil radii squared. Default: the open area of
            an ``OpenArea``, else the sum of squared amplitudes.

    Example:
        >>> from kornia_tidy.optics.aperture import circular_aperture
        >>> pupil = Pupil(circular_aperture(23), 0.1)
        >>> round(pupil.light, 2), round(pupil.extent, 2)
        (3.17, 1.05)
    """

    amplitude: Tensor
    cell_pitch: float
    fill_factor: float = 1.0
    light: float = math.nan
    transmission: Tensor = field(init=False)
    """Share of the light that passes each cell, (n, n) float64."""
    extent: float = field(init=False)
    """Half width of the open part in pupil radii; twice it bounds the frequencies in a PSF."""
    max_rho2: float = field(init=False)
    """Largest squared distance from the axis to a corner of an open cell: bounds how fast PSFs change with defocus."""

    @property
    def diameter(self) -> float:
        """Largest distance between two points of open cells in pupil radii, in any direction.

        The autocorrelation of the amplitude, and with it every PSF's transform, is zero beyond it.
        """
        rows = (self.amplitude > 0).any(1).nonzero()[:, 0]
        columns = (self.amplitude > 0)[rows].double()
        first, last = columns.argmax(1), columns.shape[1] - 1 - columns.flip(1).argmax(1)
        corners = torch.cat([torch.stack([rows + y, x], 1) for y in (0, 1) for x in (first, last + 1)]).double()
        return float(torch.cdist(corners, corners, compute_mode="donot_use_mm_for_euclid_dist").max()) * self.cell_pitch

    @property
    def field_share(self) -> float:
        """Share of the light in the field of the cells: 1, and less where cells at a hard edge hold its mean only."""
        return min(1.0, float(self.amplitude.double().square().sum()) * self.cell_pitch**2 / self.light)

    def with_amplitude(self, amplitude: Tensor, shares: Tensor, *, cut: bool) -> Pupil:
        """Return this pupil with amplitudes, learnt or one for each mask; its open part stays.

        Args:
            amplitude: (n, n), or (K, n, n) for K masks.
            shares: fraction of the exposure of each mask, (K,), to average the light of several amplitudes.
            cut: whether a lens's stop cuts them too. Otherwise each is scaled to let a light of one through.
        """
        pupil = copy.copy(self)
        passed = amplitude.double().square()
        if passed.ndim == 3:
            passed = torch.tensordot(shares.to(passed), passed, 1)
        light = amplitude.square().sum((-2, -1), keepdim=True) * self.cell_pitch**2
        total = float(passed.detach().sum()) * self.cell_pitch**2 if cut else 1.0
        scaled = amplitude if cut else amplitude / light.sqrt()
        vars(pupil).update(amplitude=scaled, transmission=passed.cpu(), light=total)
        return pupil

    def of_masks(self, masks: slice) -> Pupil:
        """Return the pupil of some of the masks: itself, unless each has its own amplitude."""
        if self.amplitude.ndim == 2:
            return self
        pupil = copy.copy(self)
        vars(pupil).update(amplitude=self.amplitude[masks])
        return pupil

    def __post_init__(self) -> None:
        size = self.amplitude.shape[-1]
        cells = torch.nonzero(self.amplitude) - (size - 1) / 2
        object.__setattr__(self, "transmission", light_through(self.amplitude))
        if math.isnan(self.light):
            object.__setattr__(self, "light", float(self.transmission.sum()) * self.cell_pitch**2)
        object.__setattr__(self, "amplitude", self.amplitude.as_subclass(Tensor))
        object.__setattr__(self, "extent", (float(cells.abs().max()) + 0.5) * self.cell_pitch)
        object.__setattr__(self, "max_rho2", float((cells.abs() + 0.5).square().sum(1).max()) * self.cell_pitch**2)


def pupil_over(mask_shape: Sequence[int], aperture: Tensor | None, fill_factor: float) -> Pupil:
    """Return the pupil over the pixels of a mask.

    Args:
        mask_shape: pixels of the masks; the shorter of the last two sides spans the pupil.
        aperture: amplitude over these pixels, or finer by a whole factor. Default: the binary disc.
        fill_factor: share of the area of each mask pixel that modulates.

    Raises:
        ValueError: if the aperture is not finer by a whole factor, or on the meta device.

    Example:
        >>> pupil_over((5, 23, 31), None, 1.0).amplitude.shape
        torch.Size([23, 23])
    """
    size = min(mask_shape[-2:])
    amplitude = circular_aperture(size, MASK_SPAN / size) if aperture is None else aperture
    check_values("aperture", amplitude)
    if amplitude.shape[-1] % size:
        raise ValueError(
            f"aperture must have a whole number of cells for each of the {size} mask pixels, got "
            f"{tuple(amplitude.shape)}"
        )
    return Pupil(amplitude, MASK_SPAN / amplitude.shape[-1], fill_factor)


def pupil_field(phase: Tensor, aperture: Tensor, dispersion: float | Tensor) -> Tensor:
    """Return the complex field behind the mask at one wavelength.

    Args:
        phase: radians at 530 nm, (K, N, N), float32 or float64.
        aperture: amplitude on the same grid or one with a whole number of cells for each mask pixel, (sN, sN), or one
            for each mask, (K, sN, sN).
        dispersion: factor that takes the phase at 530 nm to the wavelength, or such factors, (W, 1, 1, 1).

    Returns:
        (K, sN, sN) complex, or (W, K, sN, sN).

    Convention:
        - Whole waves are taken off the phase in float64: in float32 the product of 1e4 rad with ``dispersion`` would be
          off by up to 1e-3 rad. A device without float64 multiplies halves of the numbers, with exact products.

    Example:
        >>> pupil_field(torch.zeros(1, 2, 2), torch.ones(4, 4), 1.0).shape
        torch.Size([1, 4, 4])
    """
    cells = aperture.shape[-1] // phase.shape[-1]
    if has_float64(phase.device):
        angle = ((phase.double() * dispersion + math.pi).remainder(2 * math.pi) - math.pi).to(phase.dtype)
    else:
        angle = 2 * math.pi * _waves_off(phase, dispersion)
    amplitude = aperture.to(angle)
    cosine, sine = angle.cos(), angle.sin()
    if cells > 1:
        cosine, sine = (x.repeat_interleave(cells, -1).repeat_interleave(cells, -2) for x in (cosine, sine))
    return torch.complex(amplitude * cosine, amplitude * sine)


def _waves_off(phase: Tensor, dispersion: float | Tensor) -> Tensor:
    """Return float32 phases times a factor, in waves and without whole waves: to 1e-6 for phases up to 1e4 rad.

    Source: Dekker, A floating-point technique for extending the available precision, Numerische Mathematik 18 (1971).
    """
    factor = torch.as_tensor(dispersion, dtype=torch.float64, device="cpu") / (2 * math.pi)
    first = _upper_digits(factor)
    second = _upper_digits(factor - first)
    parts = torch.stack([first, second, factor - first - second]).to(phase.dtype)
    first, second, third = parts.to(phase.device).unbind()
    scaled = phase * 4097  # a product of 12 and 12 digits is exact
    high = scaled - (scaled - phase)
    low = phase - high
    waves = torch.zeros_like(phase * first)
    for product in (high * first, high * second, low * first):
        waves = waves + (product - product.detach().round())
    return waves + (high * third + low * second)


def _upper_digits(number: Tensor) -> Tensor:
    """Return numbers rounded to 12 binary digits."""
    mantissa, exponent = torch.frexp(number)
    return torch.ldexp((mantissa * 4096).round(), exponent - 12)


def gapped_pupil_field(phase: Tensor, aperture: Tensor, dispersion: float | Tensor) -> Tensor:
    r"""Return the field behind a mask with gaps between its pixels, to be used with :func:`gapped_cells`.

    Light through the gaps keeps its phase, so the field is that of the open aperture, A on whole cells, plus the mask's
    change, :math:`A (e^{i\phi} - 1)`, on the modulating part of each cell.

    Args:
        phase: radians at 530 nm, (K, N, N), float32 or float64.
        aperture: amplitude, (n, n), as for :func:`pupil_field`.
        dispersion: as for :func:`pupil_field`.

    Returns:
        (K, 2n, 2n) complex, or (W, K, 2n, 2n): the change and the open aperture as blocks on the diagonal.

    Example:
        >>> gapped_pupil_field(torch.zeros(1, 2, 2), torch.ones(2, 2), 1.0)[0].real
        tensor([[0., 0., 0., 0.],
                [0., 0., 0., 0.],
                [0., 0., 1., 1.],
                [0., 0., 1., 1.]])
    """
    cells = aperture.shape[-1]
    field = pupil_field(phase, aperture, dispersion)
    still = aperture.to(field)
    change = pad(field - still, (0, cells, 0, cells))
    return change + pad(still, (cells, 0, cells, 0))


def gapped_cells(num_cells: int, per_pixel: int, fill_factor: float) -> Tensor:
    """Return where along one axis the modulating parts of all cells begin and end, and then the cells themselves.

    Args:
        num_cells: cells n along a side.
        per_pixel: cells along a side of a mask pixel; a modulating square may end within a cell.
        fill_factor: share of the area of each mask pixel that modulates.

    Returns:
        (2, 2n) float64 in cells, from the optical axis.

    Example:
        >>> gapped_cells(2, 1, 0.25)
        tensor([[-0.7500,  0.2500, -1.0000,  0.0000],
                [-0.2500,  0.7500,  0.0000,  1.0000]], dtype=torch.float64)
    """
    begin = torch.arange(num_cells, dtype=torch.float64) - num_cells / 2
    whole = torch.stack([begin, begin + 1])
    middle = begin[::per_pixel].repeat_interleave(per_pixel) + per_pixel / 2
    half = per_pixel * math.sqrt(fill_factor) / 2
    active = whole.clamp(middle - half, middle + half)  # empty where a cell lies in the gap
    return torch.cat([active, whole], 1)
