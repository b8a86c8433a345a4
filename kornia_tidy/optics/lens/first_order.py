"""Paraxial optics of a prescription: focal length, entrance pupil, and where the sensor stands."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from kornia_tidy.optics.lens.prescription import LONGEST, Prescription, Surface
from kornia_tidy.optics.lens.rays import Array
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH


@dataclass(frozen=True, eq=False)
class FirstOrder:
    """A lens at an f-number and a focus, all lengths in metres, paraxial at one wavelength.

    Args:
        prescription: the lens.
        vertices: z of every surface; the first refracting vertex is at 0.
        focal_length: effective focal length.
        pupil_z: place of the entrance pupil.
        pupil_radius: radius of the entrance pupil.
        stop_radius: radius of the stop.
        sensor_z: place of the sensor.
        focus_distance: of the plane in focus, in front of the entrance pupil.
        rear: matrix from the stop's plane to the sensor, on heights and slopes.
    """

    prescription: Prescription
    vertices: Array
    focal_length: float
    pupil_z: float
    pupil_radius: float
    stop_radius: float
    sensor_z: float
    focus_distance: float
    rear: Array


def first_order(
    prescription: Prescription, f_number: float, focus_distance: float, wavelength: float = REFERENCE_WAVELENGTH
) -> FirstOrder:
    """Return the paraxial quantities of a lens.

    Args:
        prescription: the lens.
        f_number: focal length over diameter of the entrance pupil.
        focus_distance: from the entrance pupil to the plane in focus, in metres; ``inf`` is allowed.
        wavelength: in metres.

    Raises:
        ValueError: if the lens does not collect light, or its stop has no image in front of it.

    Source: Born and Wolf, Principles of Optics, section 4.4 (matrices of paraxial rays).
    """
    surfaces, stop = prescription.surfaces, prescription.stop
    indices = prescription.indices(wavelength)
    vertices = np.concatenate([[0.0], np.cumsum([s.gap for s in surfaces[:-1]])])
    vertices = vertices - vertices[next(i for i, s in enumerate(surfaces) if not s.is_stop)]
    whole = _matrix(surfaces, vertices, indices)
    power = -whole[1, 0]
    if not power > 0:
        raise ValueError(f"the lens must collect light, got a power of {power:g} 1/m")
    focal_length = 1 / power
    if focal_length > LONGEST:
        raise ValueError(
            f"the focal length of a prescription must be at most {LONGEST:g} m, got {focal_length:.4g} m: if its "
            f"lengths are millimetres, give it 'unit': 'mm'"
        )
    to_stop = np.eye(2)
    if stop:
        front = _matrix(surfaces[:stop], vertices[:stop], indices[:stop])
        to_stop = _gap(vertices[stop] - vertices[stop - 1], indices[stop - 1]) @ front
    if not abs(to_stop[0, 0]) > 1e-6:
        raise ValueError("the stop must have an image in front of the lens, got one at infinity")
    pupil_z = vertices[0] + to_stop[0, 1] / to_stop[0, 0]
    pupil_radius = focal_length / f_number / 2

    def image_z(distance: float) -> float:
        """Return where a plane at a distance from the entrance pupil comes to focus."""
        height, slope = (1.0, 0.0) if math.isinf(distance) else (distance - pupil_z + vertices[0], 1.0)
        height, slope = whole @ np.array([height, slope])
        return float("nan") if slope == 0 else vertices[-1] - height / slope

    shift = 0.0 if prescription.image_plane is None else prescription.image_plane - image_z(math.inf)
    sensor_z = image_z(focus_distance) + shift
    if not vertices[-1] < sensor_z < 1e3 * focal_length:
        raise ValueError(
            f"focus_distance must be one that the lens brings to a sensor behind it, got {focus_distance} m, which "
            f"puts the sensor {sensor_z - vertices[-1]:g} m behind the last surface"
        )
    behind = _matrix(surfaces[stop + 1 :], vertices[stop + 1 :], indices[stop + 1 :], indices[stop])
    rear = _gap(sensor_z - vertices[-1], 1.0) @ behind @ _gap(vertices[stop + 1] - vertices[stop], indices[stop])
    rear = rear @ np.diag([1.0, indices[stop]])  # on slopes in the stop
    lengths = focal_length, pupil_z, pupil_radius, pupil_radius * abs(to_stop[0, 0]), sensor_z, focus_distance
    return FirstOrder(prescription, vertices, *map(float, lengths), rear)


def _matrix(surfaces: tuple[Surface, ...], vertices: Array, indices: list[float], before: float = 1.0) -> Array:
    """Return the matrix on heights and reduced slopes from before the first surface to behind the last one."""
    matrix = np.eye(2)
    for i, surface in enumerate(surfaces):
        if i:
            matrix = _gap(vertices[i] - vertices[i - 1], before) @ matrix
        curvature = surface.curvature + 2 * dict(surface.powers).get(2, 0.0)
        matrix = np.array([[1.0, 0.0], [-(indices[i] - before) * curvature, 1.0]]) @ matrix
        before = indices[i]
    return matrix


def _gap(length: float, index: float) -> Array:
    return np.array([[1.0, length / index], [0.0, 1.0]])
