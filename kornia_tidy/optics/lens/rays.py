"""Sequential ray tracing in float64: rays through surfaces of revolution, with their optical path."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from kornia_tidy.optics.lens.prescription import Surface

Array = np.ndarray[Any, np.dtype[np.float64]]
_STEPS, _CLOSE = 60, 1e-13  # of Newton's method on an aspheric surface; metres, before its last step


@dataclass(frozen=True, eq=False)
class Rays:
    """Rays in one medium.

    Args:
        point: (N, 3) metres.
        direction: (N, 3) unit vectors.
        path: (N,) optical path since they started, metres.
    """

    point: Array
    direction: Array
    path: Array

    def at_plane(self, z: float, index: float = 1.0) -> Self:
        """Return the rays where they cross a plane across the axis."""
        step = (z - self.point[:, 2]) / self.direction[:, 2]
        return replace(self, point=self.point + step[:, None] * self.direction, path=self.path + index * step)

    def reversed(self) -> Self:
        """Return the rays as they run back."""
        return replace(self, direction=-self.direction)


def trace(
    rays: Rays, surfaces: tuple[Surface, ...], vertices: Array, indices: list[float], first_index: float = 1.0
) -> tuple[Rays, list[Array]]:
    """Trace rays through surfaces in the order given; NaN where a ray misses one or is totally reflected.

    Args:
        rays: before the first surface.
        surfaces: to trace through.
        vertices: z of their vertices, (S,) metres.
        indices: refractive index behind each.
        first_index: before the first.

    Returns:
        The rays behind the last surface, and their distance from the axis on each surface, (N,) metres.
    """
    index, heights = first_index, []
    for surface, vertex, behind in zip(surfaces, vertices, indices, strict=True):
        local = rays.point - np.array([0.0, 0.0, vertex])
        step, normal = _hit(surface, local, rays.direction)
        point = rays.point + step[:, None] * rays.direction
        direction = rays.direction if index == behind else _refracted(rays.direction, normal, index / behind)
        rays = Rays(point, direction, rays.path + index * step)
        heights.append(np.hypot(point[:, 0], point[:, 1]))
        index = behind
    return rays, heights


def _hit(surface: Surface, point: Array, direction: Array) -> tuple[Array, Array]:
    """Return the distance to a surface along rays, and its normal there, both relative to its vertex."""
    c, q = surface.curvature, 1 + surface.conic
    with np.errstate(invalid="ignore", divide="ignore"):
        along = point[:, :2] * direction[:, :2]
        # c (x^2 + y^2 + q z^2) = 2 z along the ray is a quadratic a t^2 + 2 b t + e = 0.
        a = c * (direction[:, 0] ** 2 + direction[:, 1] ** 2 + q * direction[:, 2] ** 2)
        b = c * (along.sum(1) + q * point[:, 2] * direction[:, 2]) - direction[:, 2]
        e = c * (point[:, 0] ** 2 + point[:, 1] ** 2 + q * point[:, 2] ** 2) - 2 * point[:, 2]
        root = np.sqrt(b * b - a * e)
        step = e / (-b + np.where(b < 0, root, -root))  # the crossing nearer to the vertex
        if surface.powers:
            step = np.where(np.isfinite(step), step, -point[:, 2] / direction[:, 2])
            step = _hit_asphere(surface, point, direction, step)
        place = point + step[:, None] * direction
        if surface.powers:
            _, slope = _sag(surface, place[:, 0], place[:, 1])
            normal = np.stack([-slope * place[:, 0], -slope * place[:, 1], np.ones_like(slope)], 1)
        else:
            normal = np.stack([-c * place[:, 0], -c * place[:, 1], 1 - c * q * place[:, 2]], 1)
        return step, normal / np.linalg.norm(normal, axis=1, keepdims=True)


def _hit_asphere(surface: Surface, point: Array, direction: Array, step: Array) -> Array:
    for _ in range(_STEPS):
        x, y, z = (point + step[:, None] * direction).T
        sag, slope = _sag(surface, x, y)
        change = (z - sag) / (direction[:, 2] - slope * (x * direction[:, 0] + y * direction[:, 1]))
        step = step - change
        if not np.any(np.abs(change) > _CLOSE):
            break
    return step


def _sag(surface: Surface, x: Array, y: Array) -> tuple[Array, Array]:
    """Return the sag and its derivative over r, divided by r."""
    c, squared = surface.curvature, x * x + y * y
    root = np.sqrt(1 - (1 + surface.conic) * c * c * squared)
    sag, slope = c * squared / (1 + root), c / root
    radius = np.sqrt(squared)
    for power, coefficient in surface.powers:
        sag = sag + coefficient * radius**power
        slope = slope + coefficient * power * radius ** (power - 2)
    return sag, slope


def _refracted(direction: Array, normal: Array, ratio: float) -> Array:
    """Return directions behind a surface by Snell's law in its vector form."""
    cosine = (normal * direction).sum(1)
    sign = np.sign(cosine)
    with np.errstate(invalid="ignore"):
        behind = sign * np.sqrt(1 - ratio**2 * (1 - cosine**2))
    return ratio * direction + (behind - ratio * cosine)[:, None] * normal
