r"""Wavefronts of a lens at its stop, by rays that join the stop's points with the object and with the image.

Light that a mask in the stop diffracts leaves it in other directions. What arrives at the image point P from the
stop's point q came along the ray that joins q and P, whatever ray of the object went through q. So

.. math:: W(q) = [O \to q] + [q \to P] - \text{the same of the stop's centre},

with the optical path of the ray from the object O to q, and that of the ray from q to P. No exit pupil is needed, which
may be aberrated beyond use. P is where the ray through the stop's centre meets the sensor.

Source: Born and Wolf, Principles of Optics, section 8.3 (diffraction in the opening of the stop); aiming by Newton's
method.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from kornia_tidy.optics.lens.first_order import FirstOrder
from kornia_tidy.optics.lens.rays import Array, Rays, trace
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH

_STEPS, _CLOSE = 40, 1e-11  # of Newton's method; of the aim, in parts of the stop's radius or of the focal length
_NUDGE = 1e-5  # step for the Jacobian


@dataclass(frozen=True, eq=False)
class Wavefronts:
    """Wavefronts of H field heights and S depths over N points of the stop, at one wavelength; fields lie along +x.

    Args:
        path: optical path relative to the stop's centre, (H, S, N) metres.
        direction: cosines along x and y in which the rays arrive at the image, relative to the centre's, (H, S, N, 2).
        pupil: where the object's rays cross the entrance pupil's plane, (H, S, N, 2) metres.
        tangent: slope of the line from the entrance pupil's centre to the object, (H, S).
        chief: height at which the ray through the stop's centre meets the sensor, (H, S) metres.
        heights: distance from the axis on each surface, in clear radii, (surfaces, H, S, N).
    """

    path: Array
    direction: Array
    pupil: Array
    tangent: Array
    chief: Array
    heights: Array


def inverse_distance(system: FirstOrder, psi: Array) -> Array:
    """Return 1 / distance from the entrance pupil of the plane with a defocus in radians, in 1/m."""
    return psi * REFERENCE_WAVELENGTH / (math.pi * system.pupil_radius**2) + 1 / system.focus_distance


def wavefronts(system: FirstOrder, wavelength: float, fields: Array, psi: Array, points: Array) -> Wavefronts:
    """Trace the wavefronts of field points at the stop.

    Args:
        system: the lens at its f-number and focus.
        wavelength: in metres.
        fields: heights (H,) on the sensor in metres where rays of 530 nm through the stop's centre land.
        psi: depths (S,) as defocus in radians.
        points: (N, 2) in stop radii, x along the field.

    Raises:
        ValueError: if a ray does not get through the lens.
    """
    inverse = inverse_distance(system, psi)
    slope, at_pupil = _chief_lines(system, fields)
    tangent = slope[:, None] - at_pupil[:, None] * inverse
    points = np.concatenate([np.zeros((1, 2)), points])
    shape = (len(fields), len(psi), len(points))
    stop_points = np.broadcast_to(points * system.stop_radius, (*shape, 2)).reshape(-1, 2)
    flat = lambda x: np.broadcast_to(x[..., None], shape).ravel()  # noqa: E731
    objects = flat(tangent), flat(np.broadcast_to(inverse, shape[:2]))
    indices = system.prescription.indices(wavelength)
    pupil, front, front_heights = _from_object(system, indices, objects, stop_points)
    rays, rear_heights, chief = _to_image(system, indices, front, shape)
    path = (front.path + rays.path).reshape(shape)
    direction = rays.direction[:, :2].reshape(*shape, 2)
    clear = np.array([s.clear for s in system.prescription.surfaces if not s.is_stop])
    heights = np.stack([*front_heights, *rear_heights]).reshape(-1, *shape) / clear[:, None, None, None]
    if not np.isfinite(path).all():
        h, _, n = np.argwhere(~np.isfinite(path))[0]
        raise ValueError(
            f"no ray through the stop at {np.hypot(*points[n]):.2f} of its radius reaches the sensor {fields[h]:g} m "
            f"from the axis: give a smaller field, or a larger f_number than this aperture of "
            f"{2 * system.pupil_radius:g} m"
        )
    relative = direction - direction[:, :, :1]
    whole = path - path[:, :, :1]
    crossing = pupil.reshape(*shape, 2)
    return Wavefronts(whole[:, :, 1:], relative[:, :, 1:], crossing[:, :, 1:], tangent, chief, heights[..., 1:])


def _chief_lines(system: FirstOrder, fields: Array) -> tuple[Array, Array]:
    """Return slope and height at the entrance pupil of the rays of 530 nm from the stop's centre to the sensor."""
    indices, stop = system.prescription.indices(REFERENCE_WAVELENGTH), system.prescription.stop
    centre = np.tile([0.0, 0.0, system.vertices[stop]], (len(fields), 1))
    target = np.stack([fields, np.zeros_like(fields)], 1)

    def landing(slopes: Array) -> Array:
        rays = Rays(centre, _unit(slopes), np.zeros(len(slopes)))
        return _behind(system, indices, rays)[0].point[:, :2]

    slopes = _solved(landing, target / system.rear[0, 1], target, _CLOSE * system.focal_length)
    rays = Rays(centre, -_unit(slopes), np.zeros(len(fields)))
    if stop:
        surfaces = system.prescription.surfaces[:stop][::-1]
        before = [1.0, *indices[: stop - 1]][::-1]
        rays, _ = trace(rays, surfaces, system.vertices[:stop][::-1], before, indices[stop])
    at_pupil = rays.at_plane(system.pupil_z)
    return at_pupil.direction[:, 0] / at_pupil.direction[:, 2], at_pupil.point[:, 0]


def _from_object(
    system: FirstOrder, indices: list[float], objects: tuple[Array, Array], stop_points: Array
) -> tuple[Array, Rays, list[Array]]:
    """Return the rays of object points in the stop's points, and where they cross the entrance pupil's plane."""
    stop = system.prescription.stop
    surfaces, vertices = system.prescription.surfaces[:stop], system.vertices[:stop]

    def traced(pupil: Array) -> tuple[Rays, list[Array]]:
        rays = _launched(system, objects, pupil)
        if not stop:
            return rays.at_plane(system.vertices[0]), []
        rays, heights = trace(rays, surfaces, vertices, indices[:stop])
        return rays.at_plane(system.vertices[stop], indices[stop - 1]), heights

    start = stop_points * (system.pupil_radius / system.stop_radius)
    close = _CLOSE * system.stop_radius
    pupil = _solved(lambda p: traced(p)[0].point[:, :2], start, stop_points, close) if stop else start
    return pupil, *traced(pupil)


def _launched(system: FirstOrder, objects: tuple[Array, Array], pupil: Array) -> Rays:
    """Return rays of object points through points of the entrance pupil's plane; their path starts at its centre's.

    With the inverse distance k and tangent t the object is at -(t, 1) / k, so that r - r0 is
    (k p^2 + 2 p t) / (k r + k r0), which has no large numbers to subtract and holds at infinity.
    """
    tangent, inverse = objects
    x, y = pupil.T
    slopes = np.stack([tangent + inverse * x, inverse * y], 1)
    length = np.sqrt((slopes**2).sum(1) + 1)
    path = (inverse * (x * x + y * y) + 2 * x * tangent) / (length + np.sqrt(1 + tangent**2))
    point = np.stack([x, y, np.full_like(x, system.pupil_z)], 1)
    return Rays(point, _unit(slopes), path)


def _to_image(
    system: FirstOrder, indices: list[float], front: Rays, shape: tuple[int, int, int]
) -> tuple[Rays, list[Array], Array]:
    """Return the rays from the stop's points to the image point, their heights, and the image point's height."""
    centres = lambda x: x.reshape(*shape, 3)[:, :, 0].reshape(-1, 3)  # noqa: E731
    chief_rays = Rays(centres(front.point), centres(front.direction), np.zeros(shape[0] * shape[1]))
    image = _behind(system, indices, chief_rays)[0].point[:, :2]
    slopes = chief_rays.direction[:, :2] / chief_rays.direction[:, 2:]
    spread = lambda x: np.repeat(x, shape[2], axis=0)  # noqa: E731
    target = spread(image)
    start = spread(slopes) - front.point[:, :2] * (system.rear[0, 0] / system.rear[0, 1])
    from_stop = Rays(front.point, front.direction, np.zeros(len(target)))

    def landing(slopes: Array) -> Array:
        return _behind(system, indices, replace(from_stop, direction=_unit(slopes)))[0].point[:, :2]

    slopes = _solved(landing, start, target, _CLOSE * system.focal_length)
    rays, heights = _behind(system, indices, replace(from_stop, direction=_unit(slopes)))
    return rays, heights, image[:, 0].reshape(shape[:2])


def _behind(system: FirstOrder, indices: list[float], rays: Rays) -> tuple[Rays, list[Array]]:
    """Return rays from the stop on the sensor, and their heights on the surfaces between."""
    stop = system.prescription.stop
    surfaces, vertices = system.prescription.surfaces[stop + 1 :], system.vertices[stop + 1 :]
    rays, heights = trace(rays, surfaces, vertices, indices[stop + 1 :], indices[stop])
    return rays.at_plane(system.sensor_z), heights


def _unit(slopes: Array) -> Array:
    """Return unit vectors along +z with these slopes."""
    direction = np.concatenate([slopes, np.ones((len(slopes), 1))], 1)
    return direction / np.linalg.norm(direction, axis=1, keepdims=True)


def _solved(function: Callable[[Array], Array], start: Array, target: Array, close: float) -> Array:
    """Solve function(x) = target for two unknowns of each ray by Newton's method; NaN where it finds nothing."""
    x, miss = start, function(start) - target
    nudge = _NUDGE * max(float(np.abs(start).max()), 1e-9)
    for _ in range(_STEPS):
        if not np.any(np.abs(miss) > close):
            break
        columns = [(function(x + step) - target - miss) / nudge for step in ([nudge, 0.0], [0.0, nudge])]
        (a, c), (b, d) = columns[0].T, columns[1].T
        with np.errstate(invalid="ignore", divide="ignore"):
            change = np.stack([d * miss[:, 0] - b * miss[:, 1], a * miss[:, 1] - c * miss[:, 0]], 1)
            change = change / (a * d - b * c)[:, None]
        for _ in range(8):  # halved where the ray is lost or comes farther from its target
            found = function(x - change) - target
            worse = ~((found**2).sum(1) <= 4 * (miss**2).sum(1) + close**2)
            if not worse.any():
                break
            change = np.where(worse[:, None], change / 2, change)
        x, miss = x - change, found
    return np.where(np.abs(miss).max(1, keepdims=True) <= 1e3 * close, x, np.nan)
