"""PSFs over the field: a bank for each of several points of the picture, with the light that each receives."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from kornia_tidy.checks import check_finite
from kornia_tidy.optics.default_device import on_cpu
from kornia_tidy.optics.lens.lens import Lens
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH, Spectrum
from kornia_tidy.psf.field import Field
from kornia_tidy.psf.lens_psfs import Screen, Sensor, lens_light, lens_limits, lens_psfs, mirror_images, turned_lenses
from kornia_tidy.psf.measured_field import place_weights
from kornia_tidy.psf.psf_bank import BankOfPSFs, PSFBank
from kornia_tidy.psf.pupil import Pupil, gapped_cells, pupil_field

_LEAST, _MOST = 1e-7, 1e-3  # tolerance of the field
_HEIGHTS = 9  # in the lens's field, where lateral colour is looked at: grids are alike whichever points are asked for
FEWEST_CELLS = 23  # along a side of the stop, where they are alike


@dataclass(frozen=True, eq=False)
class FieldBank(BankOfPSFs):
    """Point spread functions over field, defocus and colour.

    Args:
        psfs: (F, D, C, P, P), light in each pixel in parts of that of an even scene on the axis; the centre is where
            the chief ray of the colour lands.
        defocus: (D,) nodes in radians at the pupil edge at 530 nm.
        field: (F, 2) points of the field, y and x in sensor pixels from the axis.
        energy: (F, D, C) share of the point's light inside the window, before anything is done about the rest.
        light: (F, D, C) relative illumination: light of an even scene over that on the axis.
        veil: (F, D, C) light that the renderer spreads evenly over the image, or None for none.

    Convention:
        - PSFs sum to ``energy * light``, so that vignetting stays; after ``with_stray_light("renormalize")`` to
          ``light``.

    Example:
        >>> from kornia_tidy.psf import PSFModel
        >>> model = PSFModel(lens="single-50mm", fidelity="draft")
        >>> bank = model.psf_bank(defocus=[0.0], field=[(0.0, 0.0), (550.0, 630.0)])
        >>> bank.psfs.shape[:3], round(float(bank.light[1, 0, 1]), 2)
        (torch.Size([2, 1, 3]), 0.97)
    """

    axes = ("F", "D", "C")
    words, form = "PSF bank over the field", "kornia_tidy.field_bank/1"

    field: Tensor
    energy: Tensor
    light: Tensor
    veil: Tensor | None = None

    def at(self, index: int) -> PSFBank:
        """Return the bank of one point of the field; its PSFs keep the light that they have there."""
        veil = None if self.veil is None else self.veil[index]
        return PSFBank(self.psfs[index], self.defocus, self.energy[index], veil)

    def between(self, field: Field, pixel: tuple[float, float]) -> PSFBank:
        """Return the PSFs at a pixel of the picture, from the nodes of its field in this bank.

        Args:
            field: where the nodes stand.
            pixel: row and column in the picture.
        """
        rows, columns = (field.along(axis, torch.tensor([float(pixel[axis])]))[0] for axis in (0, 1))
        return self._mixed((rows.T * columns).view(1, -1)).at(0)

    def at_places(self, places: Sequence[tuple[float, float]]) -> FieldBank:
        """Return measured PSFs at other points of the field, see :func:`~kornia_tidy.psf.measured_field.place_weights`.

        Args:
            places: (y, x) in sensor pixels from the axis.
        """
        return self._mixed(
            place_weights(self.field, places), field=self.field.new_tensor([list(own) for own in places])
        )

    def _mixed(self, weights: Tensor, **rest: Tensor) -> FieldBank:
        """Return the bank at n places, a mixture of the nodes with the weights (n, F)."""
        held = {k: value for k, value in self.present().items() if k != "defocus" and k not in rest}
        return replace(self, **{k: torch.tensordot(weights.to(value), value, 1) for k, value in held.items()}, **rest)

    @classmethod
    def from_measured(
        cls, banks: Sequence[PSFBank], field: Sequence[tuple[float, float]], light: Sequence[float] | None = None
    ) -> FieldBank:
        """Return PSFs measured at several places of the picture, for ``optics.with_bank``.

        Args:
            banks: of each place, such as ``PSFBank.load`` reads from a file of ``kornia-tidy raw calibrate-psf``, with
                the same defocus, colours and window.
            field: the places, y and x in sensor pixels from the lens's axis: one or more, in any arrangement.
            light: of an even scene at each place over that on the axis. Default: 1, no vignetting.

        Raises:
            TypeError: if the places are not numbers.
            ValueError: if there is not one place for each bank, or banks differ in defocus, colours or window.

        Example:
            >>> banks = [PSFBank.from_measured(torch.rand(2, 3, 5, 5), torch.tensor([-5.0, 5.0])) for _ in range(3)]
            >>> FieldBank.from_measured(banks, [(0, 0), (0, 600), (500, 0)]).psfs.shape
            torch.Size([3, 2, 3, 5, 5])
        """
        places = checked_places(field)
        shares = [1.0] * len(places) if light is None else [float(share) for share in light]
        if not len(banks) == len(places) == len(shares) or len(set(places)) < len(places):
            raise ValueError(
                f"each bank must have its own place and light, got {len(banks)} banks, {len(set(places))} different "
                f"places and {len(shares)} values of light"
            )
        if not all(0 < share < math.inf for share in shares):
            raise ValueError(f"light must be positive, got {shares!r:.80}")
        first = banks[0]
        for bank in banks:
            if bank.psfs.shape != first.psfs.shape or not torch.allclose(bank.defocus, first.defocus, 1e-4, 1e-4):
                raise ValueError(
                    f"banks of all places must have the same defocus, colours and window, got "
                    f"{tuple(first.psfs.shape)} and {tuple(bank.psfs.shape)}: take bank.at_defocus(nodes) of each"
                )
        there = first.psfs.new_tensor(shares)[:, None, None].expand(-1, *first.energy.shape).contiguous()
        psfs = torch.stack([bank.psfs for bank in banks]) * there[..., None, None]
        energy, points = torch.stack([bank.energy for bank in banks]), first.psfs.new_tensor(places)
        return cls(psfs, first.defocus, points, energy, there)

    def with_all_light(self) -> FieldBank:
        """Return a bank with PSFs that sum to ``light``, whatever was done about light outside the window."""
        total = self.psfs.sum((-2, -1)).clamp(min=torch.finfo(self.psfs.dtype).tiny)
        return replace(self, psfs=self.psfs * (self.light / total)[..., None, None])


@on_cpu
def check_field(field: Sequence[tuple[float, float]], lens: Lens | None) -> list[tuple[float, float]]:
    """Return points of the field, or raise ``ValueError`` or ``TypeError`` without a lens or for other values."""
    if lens is None:
        raise ValueError(
            "field points need a camera with a lens, got none: give it lens='double-gauss-50mm' or another"
        )
    return checked_places(field)


@on_cpu
def checked_places(field: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Return points of the field, or raise ``ValueError`` or ``TypeError`` for other values."""
    try:
        points = torch.as_tensor(field, dtype=torch.float64)
    except (TypeError, ValueError):
        raise TypeError(f"field must be points (y, x) in sensor pixels, got {field!r:.80}") from None
    if points.ndim != 2 or points.shape[1] != 2 or not len(points):
        raise ValueError(f"field must be one or more points (y, x) in sensor pixels, got shape {tuple(points.shape)}")
    check_finite("field", points)
    return [(y, x) for y, x in points.tolist()]


def field_psf_bank(
    phase: Tensor,
    weights: Tensor,
    pupil: Pupil,
    spectrum: Spectrum,
    dispersion: Sequence[float],
    defocus: Sequence[float],
    field: Sequence[tuple[float, float]],
    lens: Lens,
    pixel_pitch: float,
    window: int,
    tolerance: float = 1e-2,
) -> FieldBank:
    r"""Return the PSFs of a mask sequence behind a real lens, at points of the field.

    .. math:: h_{fdc} = \sum_\lambda s_c(\lambda)\, \ell_f(\lambda) \sum_k w_k h_{fdk\lambda}

    Args:
        phase: radians at 530 nm, (K, N, N).
        weights: share of the exposure of each mask, (K,), summing to one.
        pupil: transmission of the mask's plane apart from the lens's stop and rims, which cut it exactly.
        spectrum: wavelengths and how the channels weight them.
        dispersion: for each wavelength, the factor from phase at 530 nm to phase there.
        defocus: nodes in radians at 530 nm.
        field: points y, x in sensor pixels from the axis.
        lens: in front of the sensor.
        pixel_pitch: of the sensor in metres.
        window: side P of the PSFs in pixels, odd.
        tolerance: error allowed to the integrals over sensor pixels, as for the PSFs of an ideal lens.

    Raises:
        ValueError: if no light passes the pupil within the lens's stop.

    Convention:
        - PSFs of a channel are centred on its mean position: they contain the lateral colour within the channel, but
          not between channels.

    Example:
        >>> from kornia_tidy.psf import Pupil
        >>> lens, mask = Lens.named("single-50mm", 17.6, 0.595), torch.zeros(1, 23, 23)
        >>> stop, grey = Pupil(torch.ones(23, 23), 0.1), Spectrum.monochrome()
        >>> field_psf_bank(mask, torch.ones(1), stop, grey, [1.0], [0.0], [(0, 0)], lens, 8e-6, 23).psfs.shape
        torch.Size([1, 1, 1, 23, 23])
    """
    psfs, light = field_psfs(
        phase, weights, pupil, spectrum, dispersion, defocus, field, lens, pixel_pitch, window, tolerance
    )
    points = phase.new_tensor([list(point) for point in field])
    psfs = psfs.movedim(1, 0)
    return FieldBank(psfs * light[..., None, None], phase.new_tensor(defocus), points, psfs.sum((-2, -1)), light)


def field_psfs(
    phase: Tensor,
    weights: Tensor,
    pupil: Pupil,
    spectrum: Spectrum,
    dispersion: Sequence[float],
    defocus: Sequence[float],
    field: Sequence[tuple[float, float]],
    lens: Lens,
    pixel_pitch: float,
    window: int,
    tolerance: float,
) -> tuple[Tensor, Tensor]:
    """Return the PSFs of :func:`field_psf_bank` over the light of their channel, (D, F, C, P, P), and that light.

    The light of a channel is that of all planes of its basis of spectra over that on the axis, (F, D, C).

    Args:
        phase: this and the other arguments are those of :func:`field_psf_bank`.
        weights: as there.
        pupil: as there.
        spectrum: as there.
        dispersion: as there.
        defocus: as there.
        field: as there.
        lens: as there.
        pixel_pitch: as there.
        window: as there.
        tolerance: as there.
    """
    phase, pupil = _merged(phase, pupil)
    sensor = Sensor(pixel_pitch, window, min(max(tolerance / 10, _LEAST), _MOST))
    heights = [(lens.field / pixel_pitch * i / (_HEIGHTS - 1), 0.0) for i in range(_HEIGHTS)]
    apart = _lateral_shifts(lens, [*field, *heights], spectrum, pixel_pitch)
    screens = [_screens(phase, pupil, factor) for factor in dispersion]
    quadrant, images = mirror_images([(y * pixel_pitch, x * pixel_pitch) for y, x in field])
    parts: list[list[tuple[Tensor, list[Tensor]]]] = [[] for _ in spectrum.plane_weights]
    lights: list[list[Tensor]] = [[] for _ in spectrum.plane_weights]
    for w, wavelength in enumerate(spectrum.wavelengths):
        seen, mixing = _mixing(spectrum, w)
        if not seen:
            continue
        axis, *turned = turned_lenses(lens.table, [(0.0, 0.0), *quadrant], defocus, wavelength)
        on_axis = lens_light(whole_cells(pupil), pupil.transmission, [axis], sensor.tolerance).to(weights)[0]
        if not bool((on_axis > 0).all()):  # False for NaN too
            raise ValueError(
                f"aperture must let some light through the lens's stop and be finite, got an open area of "
                f"{float(on_axis.min())}"
            )
        limits, given = lens_limits(lens, defocus, wavelength), (screens[w], weights, pupil.transmission)
        energies, passed, area = lens_psfs(*given, turned, images, limits, sensor, apart[:, w, seen])
        for plane, v, weight in mixing:
            lights[plane].append(weight * area / on_axis)
            parts[plane].append((lights[plane][-1] / passed, [own[:, v] for own in energies]))
    there = torch.stack([sum(own[1:], own[0]) for own in lights], 2)
    basis = len(spectrum.basis or (1,))
    light = there.unflatten(2, (-1, basis)).sum(3).repeat_interleave(basis, 2)
    per_channel = torch.where(light == 0, 1, light)
    psfs = []
    for f in range(len(field)):
        for plane, own in enumerate(parts):
            scaled = [energies[f] * (shares[f] / per_channel[f, :, plane])[:, None, None] for shares, energies in own]
            psfs.append(sum(scaled[1:], scaled[0]))
    return torch.stack(psfs, 1).unflatten(1, (len(field), -1)), light


def _merged(phase: Tensor, pupil: Pupil) -> tuple[Tensor, Pupil]:
    """Return phase and pupil on fewer cells where these are all alike: a cell is integrated as exactly on any grid."""
    flat, open_part = phase.detach().flatten(1), pupil.amplitude
    cells = open_part.shape[-1]
    times = max(n for n in range(1, cells + 1) if cells % n == 0 and (n == 1 or cells // n >= FEWEST_CELLS))
    alike = bool((flat == flat[:, :1]).all()) and bool((open_part == open_part.flatten()[0]).all())
    if phase.requires_grad or open_part.requires_grad or times == 1 or not alike or pupil.fill_factor != 1:
        return phase, pupil
    few = cells // times
    own = phase[:, :1, :1].expand(-1, few, few)
    return own, Pupil(open_part.flatten()[0].expand(few, few), pupil.cell_pitch * times)


def field_light(
    pupil: Pupil,
    spectrum: Spectrum,
    defocus: Sequence[float],
    field: Sequence[tuple[float, float]],
    lens: Lens,
    pixel_pitch: float,
) -> Tensor:
    """Return the light of an even scene at points of the field over that on the axis, (F, D, C) float64.

    Args:
        pupil: this and the other arguments are those of :func:`field_psf_bank`.
        spectrum: as there.
        defocus: as there.
        field: as there.
        lens: as there.
        pixel_pitch: as there.
    """
    pupil = _merged(pupil.amplitude.new_zeros(1, 1, 1), pupil)[1]
    spans, found = whole_cells(pupil), []
    metres = [(0.0, 0.0), *((y * pixel_pitch, x * pixel_pitch) for y, x in field)]
    for wavelength in spectrum.wavelengths:
        turned = turned_lenses(lens.table, metres, defocus, wavelength)
        areas = lens_light(spans, pupil.transmission, turned)
        found.append(areas[1:] / areas[0])
    return torch.stack(found, -1) @ areas.new_tensor(spectrum.channel_weights).T


def light_on_axis(pupil: Pupil, amplitude: Tensor, lens: Lens) -> Tensor:
    """Return the light in focus that passes a lens's stop on the axis through each mask's amplitude, (K,) float64.

    Args:
        pupil: with the cells of the amplitudes.
        amplitude: (K, n, n).
        lens: in front of the sensor.
    """
    spans, axis = whole_cells(pupil), turned_lenses(lens.table, [(0.0, 0.0)], [0.0], REFERENCE_WAVELENGTH)
    return torch.stack([lens_light(spans, own.double().cpu().square(), axis)[0, 0] for own in amplitude])


def _mixing(spectrum: Spectrum, wave: int) -> tuple[list[int], list[tuple[int, int, float]]]:
    """Return the channels that see a wavelength, and of their planes each number, channel among these, and weight."""
    planes = [row[wave] for row in spectrum.plane_weights]
    basis = len(planes) // len(spectrum.weights)
    seen = [channel for channel, row in enumerate(spectrum.channel_weights) if row[wave]]
    return seen, [(n, v, planes[n]) for v, own in enumerate(seen) for n in range(own * basis, (own + 1) * basis)]


@on_cpu
def whole_cells(pupil: Pupil) -> Tensor:
    """Return begin and end of the cells of a mask along either axis in stop radii, (2, N) float64."""
    cells = pupil.amplitude.shape[-1]
    begin = torch.arange(cells, dtype=torch.float64) - cells / 2
    return torch.stack([begin, begin + 1]) * pupil.cell_pitch


@on_cpu
def _screens(phase: Tensor, pupil: Pupil, dispersion: float) -> list[Screen]:
    """Return the fields in the stop: of whole cells, or of a mask's modulating parts and its gaps."""
    cells = pupil.amplitude.shape[-1]
    waves = pupil_field(phase, pupil.amplitude, dispersion)
    whole = whole_cells(pupil)
    if pupil.fill_factor == 1:
        return [Screen(waves, whole)]
    active = gapped_cells(cells, cells // phase.shape[-1], pupil.fill_factor)[:, :cells] * pupil.cell_pitch
    still = pupil.amplitude.to(waves).expand_as(waves)
    return [Screen(waves - still, active), Screen(still, whole)]


@on_cpu
def _lateral_shifts(lens: Lens, field: Sequence[tuple[float, float]], spectrum: Spectrum, pitch: float) -> Tensor:
    """Return by how many pixels light of a wavelength lands beside the mean of each channel, (F, W, C, 2)."""
    points, shares = (torch.tensor(rows, dtype=torch.float64) for rows in (field, spectrum.channel_weights))
    if int((shares > 0).sum(1).max()) == 1:
        return points.new_zeros(len(points), *shares.T.shape, 2)
    heights = torch.linalg.vector_norm(points, dim=1)
    along = torch.stack([lens.lateral_colour(heights * pitch, wave) for wave in spectrum.wavelengths], 1) / pitch
    apart = along[:, :, None] - (along @ shares.T)[:, None]
    direction = points / heights.clamp(min=1e-12)[:, None]
    return apart[..., None] * direction[:, None, None]
