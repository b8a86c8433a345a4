"""Ray errors from a lens's table, against rays traced through its surfaces from the object to the sensor."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from kornia_tidy.optics import Lens
from kornia_tidy.optics.lens import NAMED_LENSES, Prescription
from kornia_tidy.optics.lens.first_order import first_order
from kornia_tidy.optics.lens.joined_rays import inverse_distance
from kornia_tidy.optics.lens.rays import Rays, trace
from kornia_tidy.psf.lens_psfs import turned_lenses
from kornia_tidy.psf.ray_errors import ray_errors, rays_in_stop
from tests.base import BaseTester
from tests.optics.lens.lenses import plano_convex

GREEN, FOCUS = 530e-9, 0.6


def landed(prescription: Prescription, f_number: float, psi: float, slope: float, count: int):
    """Where rays of an object point land: (N, 2) points in stop radii, x and y on the sensor, the chief ray's first."""
    system = first_order(prescription, f_number, FOCUS)
    distance = 1 / float(inverse_distance(system, np.array([psi]))[0])
    angle, radius = np.arange(count) * 2.4, np.sqrt(np.arange(count) / count)
    pupil = 0.98 * system.pupil_radius * np.stack([radius * np.cos(angle), radius * np.sin(angle)], 1)
    there = np.column_stack([pupil, np.full(count, system.pupil_z)])
    ray = there - np.array([-slope * distance, 0.0, system.pupil_z - distance])
    rays = Rays(there, ray / np.linalg.norm(ray, axis=1, keepdims=True), np.zeros(count))
    surfaces, stop, indices = prescription.surfaces, prescription.stop, prescription.indices(GREEN)
    before = trace(rays, surfaces[:stop], system.vertices[:stop], indices[:stop])[0]
    inside = before.at_plane(system.vertices[stop])
    behind = trace(inside, surfaces[stop + 1 :], system.vertices[stop + 1 :], indices[stop + 1 :], indices[stop])[0]
    return inside.point[:, :2] / system.stop_radius, behind.at_plane(system.sensor_z).point[:, :2]


class TestRayErrors(BaseTester):
    @pytest.mark.parametrize("psi", [-8.0, 0.0, 8.0])
    @pytest.mark.parametrize("slope", [0.0, 0.12])
    def test_feature_rays_of_a_single_element_land_where_they_are_traced(self, psi, slope):
        points, seen = landed(Prescription.read(plano_convex()), 10.0, psi, slope, 60)
        lens = Lens.from_prescription(plano_convex(), 10.0, FOCUS, wavelengths=(GREEN,), field=8e-3)
        (turned,) = turned_lenses(lens.table, [(0.0, float(seen[0, 0]))], [psi], GREEN)
        x, y = torch.from_numpy(points).T
        found = ray_errors(turned, y, x)[0].flip(-1)
        expected = torch.from_numpy(seen - seen[0])
        # The error is found to its first order: its square is left over the distance to the stop, 60 mm.
        bound = 2 * float(expected.abs().max()) ** 2 / 60e-3 + 2e-8
        self.assert_close(found, expected, rtol=0, atol=bound)

    def test_feature_of_six_elements_with_the_stop_inside_on_the_axis(self):
        prescription = Prescription.read(NAMED_LENSES["double-gauss-50mm"]["prescription"])
        points, seen = landed(prescription, 4.0, 10.0, 0.0, 60)
        lens = Lens.named("double-gauss-50mm", 4.0, FOCUS, wavelengths=(GREEN,), field=5e-3)
        (turned,) = turned_lenses(lens.table, [(0.0, 0.0)], [10.0], GREEN)
        x, y = torch.from_numpy(points).T
        errors = torch.from_numpy(seen - seen[0])
        bound = 2 * float(errors.abs().max()) ** 2 / 30e-3 + 2e-8
        self.assert_close(ray_errors(turned, y, x)[0].flip(-1), errors, rtol=0, atol=bound)

    def test_feature_defocus_and_field_turn_with_the_field_point(self):
        lens = Lens.from_seidel(50e-3, 5.0, math.inf, 10e-3, coma=3.0, astigmatism=2.0)
        y, x = torch.tensor([0.3, -0.8, 0.5]), torch.tensor([0.7, 0.1, -0.5])
        right, down = turned_lenses(lens.table, [(0.0, 6e-3), (6e-3, 0.0)], [0.0, 5.0], GREEN)
        self.assert_close(ray_errors(right, y, x), ray_errors(down, x, y).flip(-1), rtol=1e-6, atol=1e-12)

    def test_feature_coma_is_the_seidel_sum(self):
        """W131 h rho^3 cos(phi): at the top of the pupil three times the error of its side, in the same direction."""
        lens = Lens.from_seidel(50e-3, 5.0, math.inf, 10e-3, coma=3.0)
        (turned,) = turned_lenses(lens.table, [(0.0, 10e-3)], [0.0], GREEN)
        errors = ray_errors(turned, torch.tensor([0.0, 1.0]), torch.tensor([1.0, 0.0]))[0, :, 1]
        assert float(errors[0] / errors[1]) == pytest.approx(3, rel=0.05)  # the cone of rays is oblique by 0.2
        assert float(errors[1]) == pytest.approx(3 * GREEN * 10, rel=0.05)

    def test_feature_rims_take_rays_away(self):
        lens = Lens.named("double-gauss-50mm", 1.8, 5.0, wavelengths=(GREEN,), field=20e-3)
        axis, corner = turned_lenses(lens.table, [(0.0, 0.0), (0.0, 20e-3)], [0.0], GREEN)
        assert len(rays_in_stop(axis)[0]) == 217
        assert len(rays_in_stop(corner)[0]) < 150
