"""PSFs behind a real lens at points of the field: from the stop to the sensor by the rays that join them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from kornia_tidy.kernels.scattered_ops import Points
from kornia_tidy.optics.default_device import on_cpu
from kornia_tidy.optics.lens.field_table import defocus_terms
from kornia_tidy.optics.lens.lens import Lens
from kornia_tidy.optics.lens.lens_table import LensTable, degree_of, modes_of
from kornia_tidy.optics.lens.rays import Array
from kornia_tidy.optics.lens.stop_quadrature import StopQuadrature, stop_quadrature
from kornia_tidy.optics.quadrature import band_limited_quadrature
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH
from kornia_tidy.optics.zernike import zernike_polynomials
from kornia_tidy.psf.psf_cache import PSFMemory
from kornia_tidy.psf.scattered_transform import scattered_energies, scattered_grid

_FEWEST = 4  # points along a patch, for its amplitude and its edges
_LONGEST = 8.0  # radians from the middle of a patch to its edge; longer phases are cut into more patches
_BEYOND = 1.5  # times the lens's range; PSFs within it may be interpolated
_GRID = 21  # points along the stop at which the steepest phase is looked for
_HEIGHTS = 5  # in the lens's field, where it is looked for
_MARGIN = 1.02  # of the highest frequency, between these points
_MEMORY = 1 << 24  # bytes of points at once
_AT_ONCE = 1 << 14  # points whose polynomials are computed at once: arrays that a cache holds
_SMOOTH = 8  # least degree of polynomials for the light over the stop


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


@dataclass(frozen=True)
class Limits:
    """How fine the PSFs of a lens are, anywhere in its field and within a range of defocus, at one wavelength.

    Args:
        slopes: steepest wavefront in radians per stop radius, and steepest change of the direction cosines along both
            axes per stop radius, at some places and along either axis of the stop.
        cosine: largest direction cosine along an axis, less the chief ray's.
    """

    slopes: tuple[tuple[float, float], ...]
    cosine: float


class Image(NamedTuple):
    """A point of the field as the mirror image of another one.

    Args:
        index: of the other one.
        down: whether y changes its sign.
        right: whether x does.
    """

    index: int
    down: bool
    right: bool


def mirror_images(
    field: Sequence[tuple[float, float]],
) -> tuple[list[tuple[float, float]], list[Image]]:
    """Return the points of a field's quadrant of positive y and x, and how all points are mirror images of these.

    A lens is symmetric about its axis, so that a PSF is the mirror image of one behind mirrored masks. All points are
    computed in one quadrant, so that a PSF does not depend on which others are asked for.

    Example:
        >>> mirror_images([(1.0, -2.0), (-1.0, -2.0), (0.0, 3.0)])[0]
        [(1.0, 2.0), (0.0, 3.0)]
    """
    known: dict[tuple[float, float], int] = {}
    images = [Image(known.setdefault((abs(y), abs(x)), len(known)), y < 0, x < 0) for y, x in field]
    return list(known), images


@on_cpu
def lens_psfs(
    screens: Sequence[Screen],
    weights: Tensor,
    transmission: Tensor,
    turned: Sequence[TurnedLens],
    images: Sequence[Image],
    limits: Limits,
    sensor: Sensor,
    shifts: Tensor,
) -> tuple[list[Tensor], Tensor, Tensor]:
    r"""Return PSFs at field points and one wavelength, averaged over states, and the light there.

    .. math:: h(p) = \int_p \Big| \int_{stop} \sqrt{J}\, U e^{i W} e^{2 \pi i (L x + M y) / \lambda} \Big|^2

    with the wavefront W and the direction cosines L, M of the rays that join stop and image point, less the chief
    ray's. Each cell is integrated by Gauss-Legendre quadrature, cut at the stop's edge and at the rims that vignette.

    Args:
        screens: fields in the stop, which add up. Their cells lie evenly about the axis.
        weights: share of the exposure of each state, (K,).
        transmission: of light by the cells of the last screen, (N, N) float64.
        turned: the lens at some field points, see :func:`turned_lenses`.
        images: F field points as mirror images of these, see :func:`mirror_images`.
        limits: of the lens, see :func:`lens_limits`.
        sensor: pixels, window and tolerance.
        shifts: of the light along y and x in pixels, for each of V copies of the PSFs, (F, V, 2). Further rows tell
            how large shifts may be.

    Returns:
        Light in each pixel, (D, V, P, P) for each of F points; that of the whole sensor, (F, D); and the area of
        direction cosines that an even scene fills, (F, D): see :func:`lens_light`.
    """
    scale = sensor.pitch / turned[0].wavelength  # cycles per pixel of a direction cosine
    widest = max(float((screen.spans[1] - screen.spans[0]).max()) for screen in screens)
    half = max(phase + math.pi * sensor.window * scale * cosines for phase, cosines in limits.slopes) * widest / 2
    grid = scattered_grid(limits.cosine * scale, sensor.window, sensor.tolerance, float(shifts.abs().max()))
    sides = [screen.waves.shape[-1] for screen in screens]
    firsts = [sum(side**2 for side in sides[:n]) for n in range(len(sides))]
    whole = [transmission.new_empty(0)] * len(images)
    energies, passed, areas = list(whole), list(whole), list(whole)
    for members in _alike(turned, images):
        seen = [turned[images[own[0]].index] for own in members]
        mirrors = [images[i][1:] for i in members[0]]
        stops = [_stop(seen[0], screen.spans, half, sensor.tolerance) for screen in screens]
        for e, (light, area) in enumerate(_light(seen, stops[-1], [_mirrored(transmission, m) for m in mirrors])):
            lit = torch.where(light == 0, 1, light)  # where the rims cut all that the aperture leaves open it is dark
            for own, *found in zip(members, lit.to(weights), area.to(weights), strict=True):
                passed[own[e]], areas[own[e]] = found
        waves = torch.stack([torch.cat([_mirrored(s.waves, m).flatten(1) for s in screens], 1) for m in mirrors])
        cells = torch.cat(
            [
                first + stop.points.row * side + stop.points.column
                for first, side, stop in zip(firsts, sides, stops, strict=True)
            ]
        )
        basis = (
            torch.cat([stop.polynomials for stop in stops], 1) if len(stops) > 1 else stops[0].polynomials
        ).flatten(1)
        weight = torch.cat([stop.points.weight for stop in stops]) * scale
        terms = seen[0].phase_terms, seen[0].terms["amplitude"]
        rows, many = _rows(seen, -scale / grid.step, (grid.extent - 1) / 2), 2 + terms[0].shape[1]
        at_once = max(1, _MEMORY // (8 * rows.shape[1] * max(basis.shape[1], 1)))
        for start in range(0, len(seen), at_once):
            part, here = slice(start, start + at_once), torch.tensor(members[start : start + at_once])
            values = torch.stack([row @ basis for row in rows[part]]).unflatten(-1, weight.shape)
            values[:, many:] *= weight
            points = Points(*(own.to(weights.device) for own in (cells, values, *terms)))
            sums = []
            for axis in (0, 1):
                own = [grid.sums(sensor.window, shifts[here[:, e], :, axis], m[axis]) for e, m in enumerate(mirrors)]
                sums.append(torch.stack(own, 1).to(weights.device))
            found = scattered_energies(waves, weights, points, grid, *sums)
            for own, light in zip(members[part], found, strict=True):  # (D, E, V, P, P)
                for i, energy in zip(own, light.unbind(1), strict=True):
                    energies[i] = energy
    return energies, torch.stack(passed), torch.stack(areas)


@on_cpu
def lens_light(spans: Tensor, transmission: Tensor, turned: Sequence[TurnedLens], tolerance: float = 1e-4) -> Tensor:
    """Return the area of direction cosines that an even scene fills at F points, (F, D) float64: its irradiance.

    Args:
        spans: begin and end of the mask's cells along either axis in stop radii, (2, N) float64.
        transmission: of light by the cells, (N, N).
        turned: the lens at the field points.
        tolerance: of the area.
    """
    areas = [torch.empty(0)] * len(turned)
    for members in _alike(turned, [Image(i, down=False, right=False) for i in range(len(turned))]):
        seen = [turned[i] for (i,) in members]
        ((_, found),) = _light(seen, _stop(seen[0], spans, 0.0, tolerance), [transmission])
        for (i,), area in zip(members, found, strict=True):
            areas[i] = area
    return torch.stack(areas)


@on_cpu
def turned_lenses(
    table: LensTable, field: Sequence[tuple[float, float]], defocus: Sequence[float], wavelength: float
) -> list[TurnedLens]:
    """Return a lens with the view from points of the field.

    Args:
        table: of the lens in front of the sensor.
        field: places (y, x) on the sensor in metres from the axis.
        defocus: radians at 530 nm, (D,).
        wavelength: in metres.

    Convention:
        - Points beyond the lens's table give no warning: only interpolation needs them.
    """
    psi = torch.tensor(defocus, dtype=torch.float64)
    heights, azimuths = torch.tensor([(math.hypot(*p), math.atan2(*p)) for p in field], dtype=torch.float64).T
    series = table.series(heights, wavelength)
    parts = {name: getattr(series, name) for name in _PARTS}
    degree = max(2, *(degree_of(part.shape[-1], sines=name in _SINES) for name, part in parts.items()))
    turned = {name: _turned(part, azimuths, degree, sines=name in _SINES) for name, part in parts.items()}
    shifts = [(y * table.mask_shift, x * table.mask_shift) for y, x in field]
    terms = {name: defocus_terms(psi, table.reach, part.shape[1]) for name, part in parts.items() if part.ndim == 3}
    places = zip(series.edges, azimuths.tolist(), shifts, strict=True)
    return [
        TurnedLens({name: part[i] for name, part in turned.items()}, terms, degree, *place, psi, wavelength)
        for i, place in enumerate(places)
    ]


@on_cpu
def lens_limits(lens: Lens, defocus: Sequence[float], wavelength: float) -> Limits:
    """Return how fine the PSFs of a lens can be.

    As its whole field and range of defocus ask, or a multiple of the range: so that PSFs are as fine whatever they are
    computed with.
    """
    reach = max(map(abs, lens.table.reach))
    return _limits(lens.table, max(1, math.ceil(max(map(abs, defocus)) / (_BEYOND * reach or 1.0))), wavelength)


@lru_cache(maxsize=32)
def _limits(table: LensTable, times: int, wavelength: float) -> Limits:
    """Return the limits within a multiple of the lens's range of defocus."""
    heights = np.linspace(0, float(table.field[0]), _HEIGHTS)
    places = [(h * math.sin(a), h * math.cos(a)) for h in heights.tolist() for a in (0.0, math.pi / 4)]
    seen = turned_lenses(table, places, [times * end for end in table.reach], wavelength)
    polynomials, inside = _stop_grid(seen[0].degree)
    basis, stop = polynomials.flatten(1), polynomials.shape[1:]
    phase, cosines = (part.unflatten(-1, stop) for part in wavefronts(seen, basis))  # (places, 2, rows, columns)
    slopes, per_radius = [], (_GRID - 1) / 2
    for axis in (0, 1):
        valid = inside.narrow(axis, 1, _GRID - 1) & inside.narrow(axis, 0, _GRID - 1)
        steps = (part.diff(dim=axis + 2).abs()[..., valid] * per_radius for part in (phase, cosines))
        steepest, spread = (part.amax(2) for part in steps)  # (places, 2) each: at either end, along y and x
        slopes += zip(steepest.amax(1).tolist(), spread.sum(1).tolist(), strict=True)
    return Limits(tuple(slopes), float(cosines[..., inside].abs().max()) * _MARGIN)


def wavefronts(turned: Sequence[TurnedLens], polynomials: Tensor) -> tuple[Tensor, Tensor]:
    """Return wavefronts in radians at the wavelength, (F, D, S), and direction cosines along y and x, (F, 2, S).

    Args:
        turned: a lens at F field points and D depths.
        polynomials: values at S points of the stop, (J, S), or at those of each field point, (F, J, S).
    """
    rows, terms = _rows(turned, 1.0, 0.0), turned[0].phase_terms
    phases = rows[:, 2 : 2 + terms.shape[1]]
    return 2 * math.pi * terms @ phases @ polynomials, rows[:, :2] @ polynomials


@dataclass(frozen=True, eq=False)
class Stop:
    """Quadrature over the open stop, with polynomials of its points, (J, C, S), and their sums over cells, (Ji, C)."""

    points: StopQuadrature
    polynomials: Tensor
    moments: Tensor


def _alike(turned: Sequence[TurnedLens], images: Sequence[Image]) -> list[list[list[int]]]:
    """Return groups of lenses from which the open stop and the masks on it look the same, with the same mirrors.

    Of each lens the numbers of its images.
    """
    of_lens: dict[tuple[int, int], list[int]] = {}  # the second of two equal points gets another lens
    times: Counter[Image] = Counter()
    for i, image in enumerate(images):
        of_lens.setdefault((image.index, times[image]), []).append(i)
        times[image] += 1
    found: dict[Hashable, list[list[int]]] = {}
    for (index, _), own in of_lens.items():
        own.sort(key=lambda i: images[i])
        lens, mirrors = turned[index], tuple(images[i][1:] for i in own)
        found.setdefault((*lens.discs().flatten().tolist(), *lens.shift, mirrors), []).append(own)
    return list(found.values())


def _mirrored(values: Tensor, mirror: tuple[bool, bool]) -> Tensor:
    """Return values of cells, (..., N, N), mirrored along y and x."""
    return values.flip([axis for axis, turns in zip((-2, -1), mirror, strict=True) if turns])


def _stop(turned: TurnedLens, spans: Tensor, half: float, tolerance: float) -> Stop:
    """Return the open stop cell by cell, as finely as the phase asks, which changes by so much over half a cell."""
    parts = max(1, math.ceil(half / _LONGEST))
    discs, cells = (np.array(x.tolist()) for x in (turned.discs(), spans))  # a torch.func tensor has no numpy()
    given = cells, parts, (half / parts, tolerance), discs, turned.degree, turned.shift
    key = tuple(x.tobytes() if isinstance(x, np.ndarray) else x for x in given)
    *points, polynomials, moments = _STOPS.recall(key, (0.0,), lambda _: _stop_points(*given))
    return Stop(StopQuadrature(*(part[0] for part in points)), polynomials[0], moments[0])


def _stop_points(
    spans: Array, parts: int, asked: tuple[float, float], discs: Array, degree: int, shift: tuple[float, float]
) -> tuple[Tensor, ...]:
    """Return the parts of a stop with an axis of one before, as they are remembered."""
    begin, end = spans
    steps = np.arange(parts + 1) / parts
    edges = begin[:, None] + (end - begin)[:, None] * steps
    fine = np.stack([edges[:, :-1].ravel(), edges[:, 1:].ravel()])
    points = stop_quadrature(fine, band_limited_quadrature(*asked, _FEWEST), discs, shift)
    count, smooth = (_count(own) for own in (degree, max(degree, _SMOOTH)))
    polynomials = points.x.new_empty(count, *points.x.shape)
    moments = points.x.new_empty(smooth, len(points.x))
    at_once = max(1, _AT_ONCE // points.x.shape[1])  # patches
    for part in (slice(n, n + at_once) for n in range(0, len(points.x), at_once)):
        found = zernike_polynomials(smooth, points.y[part], points.x[part])
        polynomials[:, part] = found[:count]
        moments[:, part] = (found * points.weight[part]).sum(-1)
    whole = points.row // parts, points.column // parts, points.x, points.y, points.weight, polynomials, moments
    return tuple(part[None] for part in whole)


_STOPS = PSFMemory(128 << 20)


def _count(degree: int) -> int:
    return (degree + 1) * (degree + 2) // 2


@lru_cache(maxsize=8)
def _stop_grid(degree: int) -> tuple[Tensor, Tensor]:
    """Return the polynomials on a grid over the stop, (J, n, n), and where it lies within the stop's edge."""
    with torch.inference_mode(False):
        line = torch.linspace(-1, 1, _GRID, dtype=torch.float64)
        y, x = torch.meshgrid(line, line, indexing="ij")
        return zernike_polynomials(_count(degree), y, x), x.square() + y.square() <= 1 + 1e-9


@lru_cache(maxsize=8)
def _projection(degree: int) -> tuple[Tensor, Tensor]:
    """Return the polynomials at points of the disc, (J, n), and the projection of values onto a series, (n, J).

    Gauss's rule for the radius squared and evenly spaced azimuths integrate products of the polynomials exactly.
    """
    with torch.inference_mode(False):
        nodes, weights = np.polynomial.legendre.leggauss(degree // 2 + 1)
        radius, around = np.sqrt((nodes + 1) / 2)[:, None], 2 * np.pi * np.arange(2 * degree + 1) / (2 * degree + 1)
        y, x = (torch.from_numpy((radius * part(around)).ravel()) for part in (np.sin, np.cos))
        polynomials = zernike_polynomials(_count(degree), y, x)
        share = torch.from_numpy(np.repeat(weights / 2 / len(around), len(around)))
        return polynomials, (polynomials * share).T


def _light(
    turned: Sequence[TurnedLens], stop: Stop, transmissions: Sequence[Tensor]
) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield the object's light that passes each mask, and the area of cosines that it fills, (F, D) each."""
    first = turned[0]
    polynomials, series = _projection(max(first.degree, _SMOOTH))
    count = _count(first.degree)

    def over_depths(name: str, basis: Tensor) -> Tensor:  # (J, ...) to (F, D, ...)
        rows = torch.stack([own.parts[name] @ basis for own in turned])  # one product would round by how many they are
        return sum(term[:, None] * row[:, None] for term, row in zip(first.terms[name].T, rows.unbind(1), strict=True))

    light = over_depths("illumination", polynomials[:count])
    ratio = over_depths("amplitude", polynomials[:count]).square() / light
    for transmission in transmissions:
        passing = stop.moments @ transmission[stop.points.row, stop.points.column]  # of each polynomial
        yield over_depths("illumination", passing[:count, None])[..., 0], (ratio * (series @ passing)).sum(-1)


def _rows(turned: Sequence[TurnedLens], stretch: float, middle: float) -> Tensor:
    """Return the series over the stop of each quantity of its points, (F, rows, J).

    Rows are the direction cosines along y and x, less the chief ray's, times a factor and with a constant added; the
    terms of the wavefront in turns; those of the amplitude.
    """
    first = turned[0]
    parts = {name: torch.stack([own.parts[name] for own in turned]) for name in _PARTS}
    azimuth = torch.tensor([own.azimuth for own in turned], dtype=torch.float64)[:, None]
    cosine, sine = azimuth.cos(), azimuth.sin()
    along, across = parts["radial"], parts["tangential"]
    places = torch.stack([along * sine + across * cosine, along * cosine - across * sine], 1) * stretch
    places[..., 0] += middle
    wave = parts["wavefront"] * (first.scale / (2 * math.pi))
    ideal = torch.zeros(len(turned), 1, wave.shape[-1], dtype=torch.float64)
    ideal[..., 0], ideal[..., 4] = 1 / 2, 1 / math.sqrt(12)  # radius squared
    return torch.cat([places, wave, ideal, parts["amplitude"]], 1)


@lru_cache(maxsize=32)
def _places_of_modes(count: int, sines: bool) -> tuple[Tensor, Tensor, Tensor]:
    """Return the azimuthal orders of polynomials of one parity, and where they and their mirrors stand among all."""
    with torch.inference_mode(False):
        n, m = torch.tensor(modes_of(count, sines=sines)).T
        return m.double(), (n * (n + 2) + m) // 2, (n * (n + 2) - m) // 2


_PARTS = ("wavefront", "radial", "tangential", "amplitude", "illumination")
_SINES = {"tangential"}


def _turned(coefficients: Tensor, azimuths: Tensor, degree: int, *, sines: bool) -> Tensor:
    """Return series of all polynomials for fields at azimuths, (F, ..., J), from those for fields along +x."""
    whole = coefficients.new_zeros(*coefficients.shape[:-1], _count(degree))
    orders, even, odd = _places_of_modes(coefficients.shape[-1], sines)
    turns = (azimuths[:, None] * orders).view(-1, *[1] * (coefficients.ndim - 2), len(orders))
    cosine, sine = turns.cos(), turns.sin()
    whole[..., even] = coefficients * (-sine if sines else cosine)
    turning = orders > 0
    whole[..., odd[turning]] = (coefficients * (cosine if sines else sine))[..., turning]
    return whole


@dataclass(frozen=True, eq=False)
class TurnedLens:
    """A lens at one field point and D depths, in the coordinates of the mask and of the sensor.

    Args:
        parts: of the lens's table as series of all Zernike polynomials up to a degree, (terms, J) or (J,).
        terms: what sums the terms of a part at each depth, (D, terms).
        degree: of the polynomials.
        edges: of rims, centre along the field and radius in stop radii, (E, 2).
        azimuth: of the field point, from +x towards +y.
        shift: y and x from where light passes the stop to where it passes masks off the stop, in stop radii.
        psi: defocus in radians at 530 nm, (D,).
        wavelength: in metres.
    """

    parts: dict[str, Tensor]
    terms: dict[str, Tensor]
    degree: int
    edges: Tensor
    azimuth: float
    shift: tuple[float, float]
    psi: Tensor
    wavelength: float

    @property
    def scale(self) -> float:
        """From radians at 530 nm to radians at the wavelength."""
        return REFERENCE_WAVELENGTH / self.wavelength

    @property
    def phase_terms(self) -> Tensor:
        """Terms of the wavefront's rows in turns, that of an ideal lens last, (D, R) float64."""
        return torch.cat([self.terms["wavefront"], self.psi[:, None] * self.scale / (2 * math.pi)], 1)

    def discs(self) -> Tensor:
        """Return centre x, y and radius of the discs that light must pass, (E, 3): first the stop's own."""
        direction = torch.tensor([math.cos(self.azimuth), math.sin(self.azimuth)], dtype=torch.float64)
        centres = self.edges[:, :1] * direction
        return torch.cat(
            [torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64), torch.cat([centres, self.edges[:, 1:]], 1)]
        )
