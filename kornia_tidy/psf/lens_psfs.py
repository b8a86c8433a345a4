"""PSFs behind a real lens at points of the field: from the stop to the sensor by the rays that join them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from kornia_tidy.optics.default_device import on_cpu
from kornia_tidy.optics.lens.lens import Lens
from kornia_tidy.optics.lens.lens_table import LensSample, degree_of, modes_of
from kornia_tidy.optics.lens.stop_quadrature import StopQuadrature, stop_quadrature
from kornia_tidy.optics.quadrature import gauss_legendre_order
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH
from kornia_tidy.optics.zernike import zernike_polynomials
from kornia_tidy.psf.scattered_transform import patches_of, scattered_axis, scattered_energies

_LONGEST = 5.0  # radians from the middle of a patch to its edge; longer phases are cut into more patches
_BEYOND = 1.5  # times the lens's range; PSFs within it may be interpolated
_GRID = 41  # points along the stop at which the steepest phase is looked for


@dataclass(frozen=True, eq=False)
class Screen:
    """Fields on the cells of a mask in the stop.

    Args:
        waves: of each state, (K, N, N) complex.
        spans: begin and end of the cells along either axis in stop radii, (2, N) float64.
    """

    waves: Tensor
    spans: Tensor


@dataclass(frozen=True)
class Sensor:
    """Pixel pitch in metres, side of the window in pixels, and the error allowed to the field on the sensor."""

    pitch: float
    window: int
    tolerance: float


@on_cpu
def lens_psfs(
    screens: Sequence[Screen],
    weights: Tensor,
    transmission: Tensor,
    turned: TurnedLens,
    sensor: Sensor,
    shifts: Sequence[tuple[float, float]] = ((0.0, 0.0),),
) -> tuple[Tensor, Tensor]:
    r"""Return PSFs at one field point and wavelength, averaged over states, and the light there.

    .. math:: h(p) = \int_p \Big| \int_{stop} \sqrt{J}\, U e^{i W} e^{2 \pi i (L x + M y) / \lambda} \Big|^2

    with the wavefront W and the direction cosines L, M of the rays that join stop and image point, less the chief
    ray's. Each cell is integrated by Gauss-Legendre quadrature, cut at the stop's edge and at the rims that vignette.

    Args:
        screens: fields in the stop, which add up.
        weights: share of the exposure of each state, (K,).
        transmission: of light by the cells of the last screen, (N, N) float64.
        turned: the lens at the field point, see :func:`turned_lenses`.
        sensor: pixels, window and tolerance.
        shifts: of the light along y and x in pixels, one for each copy of the PSFs.

    Returns:
        Share of the light in each pixel, (D, V, P, P), and the area of direction cosines that an even scene fills,
        (D,): see :func:`lens_light`.
    """
    wavelength = turned.wavelength
    steepest, complex_dtype = turned.widest.steepest(sensor), screens[0].waves.dtype
    widest = max(float((screen.spans[1] - screen.spans[0]).max()) for screen in screens)
    stops = [_stop(turned, screen.spans, steepest * widest / 2, sensor.tolerance) for screen in screens]
    points = [stop for stop, _ in stops]
    frequencies = [turned.frequencies(basis) for _, basis in stops]
    columns, rows = (torch.cat([pair[i] * -sensor.pitch / wavelength for pair in frequencies]) for i in (0, 1))
    settings = sensor.window, sensor.tolerance, weights.dtype
    columns = scattered_axis(columns, *settings, [shift[1] for shift in shifts])
    rows = scattered_axis(rows, *settings, [shift[0] for shift in shifts])
    passed, area = turned.light(*stops[-1], transmission)
    passed = torch.where(passed == 0, 1, passed)  # where the rims cut all that the aperture leaves open it is dark
    amplitude = torch.cat([turned.amplitude(*stop) for stop in stops], 1)
    amplitude = amplitude * (sensor.pitch / wavelength / passed.detach().sqrt())[:, None, None]
    phase = torch.cat([turned.phase(stop) for stop in stops], 1)
    device = weights.device
    patches = patches_of(torch.polar(amplitude, phase).to(complex_dtype), rows, columns).to(device)
    chosen = [(p.row.to(device), p.column.to(device)) for p in points]
    cells = torch.cat([s.waves[:, row, column] for s, (row, column) in zip(screens, chosen, strict=True)], 1)
    energies = scattered_energies(cells, weights, patches, rows.to(device), columns.to(device))
    if passed.requires_grad:  # of a learnt amplitude
        energies = energies * (passed.detach() / passed).to(energies)[:, None, None, None]
    return energies, area.to(weights)


@on_cpu
def lens_light(spans: Tensor, transmission: Tensor, turned: TurnedLens, tolerance: float = 1e-4) -> Tensor:
    """Return the area of direction cosines that an even scene fills at a field point, (D,) float64: its irradiance.

    Args:
        spans: begin and end of the mask's cells along either axis in stop radii, (2, N) float64.
        transmission: of light by the cells, (N, N).
        turned: the lens at the field point.
        tolerance: of the area.
    """
    return turned.light(*_stop(turned, spans, 0.0, tolerance), transmission)[1]


@on_cpu
def turned_lenses(
    lens: Lens, field: Sequence[tuple[float, float]], defocus: Sequence[float], wavelength: float
) -> list[TurnedLens]:
    """Return a lens with the view from points of the field.

    Args:
        lens: in front of the sensor.
        field: places (y, x) on the sensor in metres from the axis.
        defocus: radians at 530 nm, (D,).
        wavelength: in metres.

    Convention:
        - Points beyond the lens's table give no warning: only interpolation needs them.
    """
    psi = torch.tensor(defocus, dtype=torch.float64)
    heights = torch.tensor([math.hypot(*point) for point in field], dtype=torch.float64)
    # PSFs are as fine as the lens's whole range asks, or a multiple of it, whatever they are computed with.
    times = max(1, math.ceil(float(psi.abs().max()) / (_BEYOND * max(map(abs, lens.table.reach)) or 1.0)))
    ends = times * torch.tensor(lens.table.reach, dtype=torch.float64)
    found = []
    for sample, own in (
        (lens.table.at(heights, ends, wavelength), ends),
        (lens.table.at(heights, psi, wavelength), psi),
    ):
        found.append([TurnedLens(sample, i, math.atan2(*point), own, wavelength) for i, point in enumerate(field)])
    for widest, turned in zip(*found, strict=True):
        turned.widest = widest
    return found[1]


Stop = tuple[StopQuadrature, Tensor]  # points in patches, (C, S), and polynomials there, (J, C, S)


def _stop(turned: TurnedLens, spans: Tensor, half: float, tolerance: float) -> Stop:
    """Return the open stop cell by cell, as finely as the phase asks, which changes by so much over half a cell."""
    parts = max(1, math.ceil(half / _LONGEST))
    order = max(4, gauss_legendre_order(half / parts, tolerance))
    discs = tuple(map(tuple, turned.discs().tolist()))
    return _stop_points(tuple(map(tuple, spans.tolist())), parts, order, discs, turned.degree)


@lru_cache(maxsize=8)
def _stop_points(
    spans: tuple[tuple[float, ...], ...], parts: int, order: int, discs: tuple[tuple[float, ...], ...], degree: int
) -> Stop:
    with torch.inference_mode(False):
        begin, end = np.array(spans)
        steps = np.arange(parts + 1) / parts
        edges = begin[:, None] + (end - begin)[:, None] * steps
        fine = np.stack([edges[:, :-1].ravel(), edges[:, 1:].ravel()])
        points = stop_quadrature(fine, order, np.array(discs))
        points = StopQuadrature(points.row // parts, points.column // parts, points.x, points.y, points.weight)
        return points, zernike_polynomials((degree + 1) * (degree + 2) // 2, points.y, points.x)


@lru_cache(maxsize=32)
def _places_of_modes(count: int, sines: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Return the azimuthal orders of polynomials of one parity, and where they and their mirrors stand among all."""
    with torch.inference_mode(False):
        n, m = torch.tensor(modes_of(count, sines=sines)).T
        return m.double(), (n * (n + 2) + m) // 2, (n * (n + 2) - m) // 2


class TurnedLens:
    """A lens at one field point of a sample, in the coordinates of the mask and of the sensor."""

    def __init__(self, sample: LensSample, index: int, azimuth: float, psi: Tensor, wavelength: float) -> None:
        self.psi, self.azimuth, self.wavelength = psi, azimuth, wavelength
        self.widest = self  # the same at the ends of the range of defocus
        self.scale = REFERENCE_WAVELENGTH / wavelength
        self.edges = sample.edges[index]
        sines = {"tangential"}
        names = ("wavefront", "radial", "tangential", "amplitude", "illumination")
        parts = {name: getattr(sample, name)[index] for name in names}
        self.degree = max(degree_of(part.shape[-1], sines=name in sines) for name, part in parts.items())
        self.parts = {name: self._turned(part, sines=name in sines) for name, part in parts.items()}

    def _turned(self, coefficients: Tensor, *, sines: bool) -> Tensor:
        """Return coefficients of all polynomials for the field's azimuth, from those for a field along +x."""
        whole = coefficients.new_zeros(*coefficients.shape[:-1], (self.degree + 1) * (self.degree + 2) // 2)
        orders, even, odd = _places_of_modes(coefficients.shape[-1], sines)
        cosine, sine = torch.cos(orders * self.azimuth), torch.sin(orders * self.azimuth)
        whole[..., even] = coefficients * (-sine if sines else cosine)
        turning = orders > 0
        whole[..., odd[turning]] = (coefficients * (cosine if sines else sine))[..., turning]
        return whole

    def _values(self, name: str, polynomials: Tensor) -> Tensor:
        coefficients, flat = self.parts[name], polynomials.flatten(1)
        rows = [row @ flat for row in coefficients.view(-1, len(flat))]  # one product would round by how many they are
        return torch.stack(rows).view(*coefficients.shape[:-1], *polynomials.shape[1:])

    def discs(self) -> Tensor:
        """Return centre x, y and radius of the discs that light must pass, (E, 3): first the stop's own."""
        direction = torch.tensor([math.cos(self.azimuth), math.sin(self.azimuth)], dtype=torch.float64)
        centres = self.edges[:, :1] * direction
        return torch.cat(
            [torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64), torch.cat([centres, self.edges[:, 1:]], 1)]
        )

    def phase(self, stop: Stop) -> Tensor:
        """Return the wavefront in radians at the wavelength, (D, C, S)."""
        points, polynomials = stop
        ideal = self.psi[:, None, None] * (points.x.square() + points.y.square())
        return (self._values("wavefront", polynomials) + ideal) * self.scale

    def frequencies(self, polynomials: Tensor) -> tuple[Tensor, Tensor]:
        """Return the direction cosines along x and y in which light arrives, less the chief ray's."""
        along, across = self._values("radial", polynomials), self._values("tangential", polynomials)
        cosine, sine = math.cos(self.azimuth), math.sin(self.azimuth)
        return along * cosine - across * sine, along * sine + across * cosine

    def amplitude(self, points: StopQuadrature, polynomials: Tensor) -> Tensor:
        """Return the amplitude of light on its way, with the quadrature's weights, (D, C, S)."""
        return self._values("amplitude", polynomials) * points.weight

    def light(self, points: StopQuadrature, polynomials: Tensor, transmission: Tensor) -> tuple[Tensor, Tensor]:
        """Return the object's light that passes the stop, and the area of cosines that it fills, (D,) each."""
        weight = points.weight * transmission[points.row, points.column][:, None]
        light = self._values("illumination", polynomials)
        return (light * weight).sum((1, 2)), (self._values("amplitude", polynomials).square() / light * weight).sum(
            (1, 2)
        )

    def steepest(self, sensor: Sensor) -> float:
        """Return a bound of the gradient of the phase over the stop and for all pixels, radians per stop radius."""
        line = torch.linspace(-1, 1, _GRID, dtype=torch.float64)
        y, x = torch.meshgrid(line, line, indexing="ij")
        polynomials = zernike_polynomials((self.degree + 1) * (self.degree + 2) // 2, y, x)
        phase = self.phase((StopQuadrature(line, line, x, y, x), polynomials))
        along, across = self.frequencies(polynomials)
        inside, slope, widest = x.square() + y.square() <= 1, 0.0, math.pi * sensor.window * sensor.pitch
        for axis in (0, 1):
            valid = inside.narrow(axis, 1, _GRID - 1) & inside.narrow(axis, 0, _GRID - 1)
            steps = [part.diff(dim=axis).abs()[valid].max() for part in (along, across)]
            of_window = widest / REFERENCE_WAVELENGTH * self.scale * sum(map(float, steps))
            slope = max(slope, float(phase.diff(dim=axis + 1).abs()[:, valid].max()) + of_window)
        return slope * (_GRID - 1) / 2
