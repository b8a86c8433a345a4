"""Fit of a lens table to traced wavefronts, with as many heights, depths and polynomials as a residual asks."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from kornia_tidy.optics.lens.field_table import defocus_terms, mirrored_nodes
from kornia_tidy.optics.lens.first_order import FirstOrder
from kornia_tidy.optics.lens.joined_rays import Wavefronts, inverse_distance, wavefronts
from kornia_tidy.optics.lens.lens_table import LensTable, count_of, modes_of, osa_indices
from kornia_tidy.optics.lens.rays import Array
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH
from kornia_tidy.optics.zernike import zernike_polynomials

DEGREE = 12  # of the fitted polynomials; unneeded ones are dropped
DEPTHS = 5
HEIGHTS = (9, 17, 33)
_CROWDING = 2.0  # of heights at the axis, for odd powers of the radius
RESIDUAL = 3e-4  # waves rms that are good enough; rays of wide aspheric lenses need more polynomials than there are
_DROPPED_PHASE, _DROPPED_MAP, _DROPPED_LIGHT = 1e-4, 2e-6, 2e-4  # waves rms; parts of the pupil's radius; of the light
_RIM = 0.15  # around 1, of the squared height in clear radii: range of the rays that fit a rim's disc
_TO_RADIANS = 2 * math.pi / REFERENCE_WAVELENGTH


@dataclass(frozen=True)
class Fit:
    """A table, and its error against wavefronts outside the fit: largest rms over the stop, in waves."""

    table: LensTable
    residual: float


def fit_table(system: FirstOrder, wavelengths: tuple[float, ...], field: float, reach: tuple[float, float]) -> Fit:
    """Trace a lens and fit its table.

    Args:
        system: the lens at its f-number and focus.
        wavelengths: in metres.
        field: largest height on the sensor in metres.
        reach: lowest and highest defocus in radians.

    Raises:
        ValueError: if a ray does not get through the lens.
    """
    points = _fit_points()
    low, high = reach
    angles = (np.arange(DEPTHS) + 0.5) * np.pi / DEPTHS
    psi = (low + high) / 2 + (high - low) / 2 * np.cos(angles) if high > low else np.array([low])
    counts = HEIGHTS if field > 0 else (1,)
    odd = any(power % 2 for surface in system.prescription.surfaces for power, _ in surface.powers)
    crowding = _CROWDING if odd else 0.0
    known: dict[float, list[_Fitted]] = {}
    fit = None
    rim = points[-DEGREE - 3 :]  # which a lens that is too fast loses, before all others are traced
    wavefronts(system, wavelengths[0], field * mirrored_nodes(counts[0], crowding).numpy(), psi[:: DEPTHS - 1], rim)
    for count in counts:
        heights = [float(h) for h in mirrored_nodes(count, crowding) * field]
        if missing := [h for h in heights if h not in known]:
            traced = [_fitted(system, w, np.array(missing), psi, points) for w in wavelengths]
            known.update({h: [part.at(i) for part in traced] for i, h in enumerate(missing)})
        fitted = [[known[h][w] for h in heights] for w in range(len(wavelengths))]
        table = _table(fitted, wavelengths, psi, reach, (field, crowding))
        fit = Fit(table, _residual(system, table, count))
        if fit.residual <= RESIDUAL:
            break
    assert fit is not None
    return fit


@dataclass(frozen=True, eq=False)
class _Fitted:
    """Coefficients at heights (H, ...) and depths S of one wavelength."""

    wavefront: Tensor  # (H, S, J)
    radial: Tensor  # (H, S, J)
    tangential: Tensor
    amplitude: Tensor
    illumination: Tensor
    chief: Tensor  # (H, S)
    tangent: Tensor
    edges: Tensor  # (H, surfaces, 3): discs, and the largest squared height in clear radii

    def at(self, height: int) -> _Fitted:
        return _Fitted(*(getattr(self, name)[height] for name in self.__dataclass_fields__))


def _fit_points() -> Array:
    """Return points of the half of the stop on one side of the field's axis, (N, 2), dense towards the edge."""
    nodes, _ = np.polynomial.legendre.leggauss(DEGREE // 2 + 3)
    radius = np.append(np.sqrt((nodes + 1) / 2), 1.0)
    angle = (np.arange(DEGREE + 3) + 0.5) * np.pi / (DEGREE + 3)
    return np.stack([np.outer(radius, np.cos(angle)).ravel(), np.outer(radius, np.sin(angle)).ravel()], 1)


def _polynomials(points: Array, *, sines: bool = False) -> Tensor:
    """Return the polynomials of one parity at points, (N, J)."""
    x, y = torch.from_numpy(points).T
    modes = osa_indices(count_of(DEGREE, sines=sines), sines=sines)
    return zernike_polynomials((DEGREE + 1) * (DEGREE + 2) // 2, y, x)[modes].T


def _fitted(system: FirstOrder, wavelength: float, heights: Array, psi: Array, points: Array) -> _Fitted:
    traced = wavefronts(system, wavelength, heights, psi, points)
    even, odd = (torch.linalg.pinv(_polynomials(points, sines=sines)) for sines in (False, True))
    ideal = torch.from_numpy(psi)[:, None] * torch.from_numpy((points**2).sum(1))
    path = torch.from_numpy(traced.path) * _TO_RADIANS - ideal
    radial, tangential = (torch.from_numpy(part) for part in np.moveaxis(traced.direction, -1, 0))
    x, y = (torch.from_numpy(part) for part in np.moveaxis(traced.pupil, -1, 0))
    tangent = torch.from_numpy(traced.tangent)
    inverse = torch.from_numpy(inverse_distance(system, psi))[:, None]
    # Solid angle of the object's light on an area of the stop, over its mean.
    obliquity = ((inverse * x + tangent[..., None]) ** 2 + (inverse * y) ** 2 + 1) ** -1.5
    light = _area(x @ even.T, y @ odd.T, points) * obliquity
    light = light / light.mean(-1, keepdim=True)
    area = _area(radial @ even.T, tangential @ odd.T, points)
    return _Fitted(
        path @ even.T,
        radial @ even.T,
        tangential @ odd.T,
        (light * area).sqrt() @ even.T,
        light @ even.T,
        torch.from_numpy(traced.chief),
        tangent,
        _edges(traced, points),
    )


def _area(along: Tensor, across: Tensor, points: Array) -> Tensor:
    """Return the factor of area of a map of the stop, from its coefficients, (..., N)."""
    steps, columns = 1e-4 * np.eye(2), []
    for step in steps:
        rise = [
            (_polynomials(points + step, sines=sines) - _polynomials(points - step, sines=sines)).T / (2 * step.sum())
            for sines in (False, True)
        ]
        columns.append((along @ rise[0], across @ rise[1]))
    (along_x, across_x), (along_y, across_y) = columns
    return (along_x * across_y - along_y * across_x).abs()


def _edges(traced: Wavefronts, points: Array) -> Tensor:
    """Return the discs that rims leave of the stop at each height, (H, surfaces, 2): centre along the field, radius.

    Near its rim a surface is met at a height r with r^2 = p + q x + s (x^2 + y^2), with circles as contours: exactly
    for paraxial rays. At the middle depth.
    """
    squares = traced.heights[:, :, traced.heights.shape[2] // 2] ** 2  # (surfaces, H, N)
    x, y = points.T
    terms = np.stack([np.ones_like(x), x, x * x + y * y], 1)
    weights = (np.exp(-(((squares - 1) / _RIM) ** 2)) + 1e-3)[..., None]
    normal = np.einsum("ni,shnk,nj->shij", terms, weights, terms)
    p, q, s = np.moveaxis(
        np.linalg.solve(normal, np.einsum("ni,shnk,shn->shi", terms, weights, squares)[..., None])[..., 0], -1, 0
    )
    centre = -q / (2 * np.maximum(s, 1e-12))
    radius = np.sqrt(np.maximum(centre**2 + (1 - p) / np.maximum(s, 1e-12), 0))
    return torch.from_numpy(np.stack([centre, radius, squares.max(-1)], -1).swapaxes(0, 1))


def _table(
    fitted: list[list[_Fitted]],
    wavelengths: tuple[float, ...],
    psi: Array,
    reach: tuple[float, float],
    field: tuple[float, float],
) -> LensTable:
    """Return the table of coefficients at heights, without negligible ones."""

    def stacked(name: str) -> Tensor:  # (W, H, S, ...)
        return torch.stack([torch.stack([getattr(part, name) for part in row]) for row in fitted])

    terms = torch.linalg.pinv(defocus_terms(torch.from_numpy(psi), reach, len(psi)))

    def over_defocus(values: Tensor) -> Tensor:  # (W, H, S, J) to (W, S, H, J)
        return torch.einsum("ts,whsj->wthj", terms, values)

    heights = mirrored_nodes(len(fitted[0]), field[1]) * field[0]
    scale = REFERENCE_WAVELENGTH / min(wavelengths) / (2 * math.pi)
    wavefront = over_defocus(stacked("wavefront"))
    chief, tangent = stacked("chief"), stacked("tangent")[0]
    relative = chief / heights[:, None].clamp(min=1e-9)
    slope = tangent / heights[:, None].clamp(min=1e-9)
    if len(heights) > 2:  # the limit at the axis, from which both depart with the square of the height
        near, far = heights[1].square(), heights[2].square()
        relative[:, 0], slope[0] = (
            (x[1] * far - x[2] * near) / (far - near) for x in (relative.transpose(0, 1), slope)
        )
    middle = len(psi) // 2
    radial, tangential = stacked("radial")[:, :, middle], stacked("tangential")[:, :, middle]
    size, amplitude = radial.abs().max(), over_defocus(stacked("amplitude"))
    edges = torch.stack([part.edges for part in fitted[len(fitted) // 2]])
    return LensTable(
        torch.tensor(wavelengths, dtype=torch.float64),
        torch.tensor(reach, dtype=torch.float64),
        torch.tensor(field, dtype=torch.float64),
        _trimmed(wavefront, _DROPPED_PHASE / scale, defocus=True),
        _trimmed(radial, _DROPPED_MAP * float(size)),
        _trimmed(tangential, _DROPPED_MAP * float(size), sines=True),
        _trimmed(amplitude, _DROPPED_LIGHT * float(amplitude.abs().max()), defocus=True),
        _trimmed(over_defocus(stacked("illumination")), _DROPPED_LIGHT, defocus=True),
        _trimmed(over_defocus(relative[..., None]), 1e-6, defocus=True)[..., 0],
        torch.einsum("ts,hs->th", terms, slope),
        edges[:, edges[..., 2].amax(0) > 1, :2],
    )


def _trimmed(values: Tensor, least: float, *, defocus: bool = False, sines: bool = False) -> Tensor:
    """Return coefficients without the highest degrees and depths with a small rms everywhere."""
    if defocus:
        rms = values.square().sum(-1).sqrt().amax((0, 2))
        values = values[:, : max(1, _needed(rms, least))]
    degree = (
        torch.tensor([n for n, _ in modes_of(values.shape[-1], sines=sines)])
        if values.shape[-1] > 1
        else torch.zeros(1)
    )
    rms = torch.stack([values[..., degree == n].square().sum(-1).sqrt().amax() for n in range(int(degree.max()) + 1)])
    last = max(0, _needed(rms, least) - 1)
    return values[..., degree <= last]


def _needed(rms: Tensor, least: float) -> int:
    """Return the number of entries to keep so that the dropped ones are small."""
    tails = rms.square().flip(0).cumsum(0).flip(0).sqrt()
    return int((tails > least).sum())


def _residual(system: FirstOrder, table: LensTable, count: int) -> float:
    """Return the largest rms in waves between the table and wavefronts between its heights and depths."""
    grid = np.linspace(-1, 1, 13)
    x, y = np.meshgrid(grid, grid)
    inside = (x**2 + y**2 <= 1) & (y >= 0)
    points = np.stack([x[inside], y[inside]], 1)
    field, crowding = table.field.tolist()
    nodes = mirrored_nodes(count, crowding).numpy()
    between = (nodes[1:] + nodes[:-1]) / 2 if count > 1 else nodes
    chosen = between[np.unique(np.linspace(0, len(between) - 1, 6).round().astype(int))] * field
    low, high = table.reach
    psi = np.array([low, low + 0.3 * (high - low), high])
    worst = 0.0
    for wavelength in table.wavelengths.tolist():
        traced = wavefronts(system, wavelength, chosen, psi, points)
        sample = table.at(torch.from_numpy(chosen), torch.from_numpy(psi), wavelength)
        basis = _polynomials(points)[:, : sample.wavefront.shape[-1]]
        ideal = torch.from_numpy(psi)[:, None] * torch.from_numpy((points**2).sum(1))
        error = torch.from_numpy(traced.path) * _TO_RADIANS - ideal - sample.wavefront @ basis.T
        rms = error.square().mean(-1).sqrt().max() * REFERENCE_WAVELENGTH / wavelength / (2 * math.pi)
        worst = max(worst, float(rms))
    return worst
