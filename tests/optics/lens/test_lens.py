"""Lenses against closed forms: perfect focus, Fermat, Seidel sums, Coddington's formulas, discs that overlap."""

from __future__ import annotations

import copy
import math
import pickle
import warnings

import numpy as np
import pytest
import torch

from kornia_tidy.optics import Lens, LensRangeWarning, ThinLensCamera
from kornia_tidy.optics.lens import Prescription
from kornia_tidy.optics.lens.first_order import first_order
from kornia_tidy.optics.lens.joined_rays import wavefronts
from kornia_tidy.optics.lens.lens_table import osa_indices
from kornia_tidy.optics.lens.made_lenses import RGB
from kornia_tidy.optics.lens.stop_quadrature import stop_quadrature
from kornia_tidy.optics.zernike import zernike_polynomials
from tests.base import BaseTester, shared
from tests.optics.lens.lenses import INDEX, plano_convex, plano_hyperbolic, symmetric_pair

GREEN = 530e-9
SEIDEL = Lens.from_seidel(50e-3, 8.0, 1.0, 10e-3)


def system(prescription: dict, f_number: float, focus: float):
    return first_order(Prescription.read(prescription), f_number, focus)


def path(lens: Lens, height: float, psi: float, x: torch.Tensor, y: torch.Tensor, wavelength: float = GREEN):
    """Wavefront of a table in radians at 530 nm, for a field along +x."""
    sample = lens.sample(torch.tensor([height]), torch.tensor([psi]), wavelength)
    count = sample.wavefront.shape[-1]
    basis = zernike_polynomials(91, y, x)[osa_indices(count)]
    return torch.tensordot(sample.wavefront[0, 0], basis, 1) + psi * (x**2 + y**2)


class TestLens(BaseTester):
    def test_feature_a_hyperboloid_focuses_a_star_without_aberration(self):
        lens = Lens.from_prescription(plano_hyperbolic(), 2.0, math.inf, wavelengths=(GREEN,), field=0.0, nearest=10.0)
        x, y = torch.linspace(-0.7, 0.7, 9).double(), torch.linspace(0, 0.7, 9).double()
        assert lens.focal_length == pytest.approx(50e-3)
        assert float(path(lens, 0.0, 0.0, x, y).abs().max()) < 1e-3

    def test_feature_seidel_sums_of_a_single_element(self):
        """Spherical aberration, coma, astigmatism and field curvature of third order: to a thousandth."""
        radius, thickness, focus, number, height = 25e-3, 3e-3, 0.5, 80.0, 3e-4
        lens = system(plano_convex(radius, thickness), number, focus)
        spherical, coma, astigmatism, petzval = self.seidel_sums(radius, thickness, focus, lens, height)
        # Of the traced paths, even and odd parts along x and y, with their powers apart.
        points = np.array([[0.5, 0.0], [1.0, 0.0], [-0.5, 0.0], [-1.0, 0.0], [0.0, 0.5], [0.0, 1.0]])
        traced = wavefronts(lens, GREEN, np.array([0.0, height]), np.array([0.0]), points).path[:, 0] / GREEN
        axis, (along, back, across) = traced[0, :2], traced[1].reshape(3, 2)
        fourth = lambda w: float(w[1] - 4 * w[0]) / (1 - 4 / 16)  # noqa: E731 (of a rho^2 + b rho^4 at 1/2 and 1)
        second = lambda w: float(w[1]) - fourth(w)  # noqa: E731
        third = lambda w: float(w[1] - 2 * w[0]) / (1 - 2 / 8)  # noqa: E731 (of a rho + b rho^3)
        even, odd = (along + back) / 2, (along - back) / 2
        assert fourth(axis) == pytest.approx(spherical, rel=1e-3)
        assert third(odd) == pytest.approx(coma, rel=1e-3)
        assert second(even) - second(across) == pytest.approx(astigmatism, rel=1e-3)
        assert second(across) - second(axis) == pytest.approx(petzval, rel=1e-3)

    @staticmethod
    def seidel_sums(radius, thickness, focus, lens, height):
        """W040, W131, W222 and W220 in waves by paraxial rays (Welford 1986, chapter 8)."""
        aperture = lens.pupil_radius
        curvature, index = [1 / radius, 0.0], [1.0, INDEX, 1.0]
        y, u, bar_y = aperture, aperture / focus, 0.0
        image = lens.sensor_z - thickness
        # The chief ray through the stop at the first surface: traced with slope 1, scaled to the image height.
        slope = 1.0 / INDEX
        bar_u = height / ((slope * thickness) + (slope * INDEX) * image)
        sums = np.zeros(4)
        n, lagrange = 1.0, None
        for c, behind in zip(curvature, index[1:], strict=True):
            if n != 1.0:
                y, bar_y = y + thickness * u, bar_y + thickness * bar_u
            a, bar_a = n * (u + y * c), n * (bar_u + bar_y * c)
            lagrange = n * (bar_u * y - u * bar_y)
            new_u = (n * u - y * c * (behind - n)) / behind
            new_bar = (n * bar_u - bar_y * c * (behind - n)) / behind
            delta = new_u / behind - u / n
            powers = -c * (1 / behind - 1 / n)
            sums += [-a * a * y * delta, -a * bar_a * y * delta, -bar_a * bar_a * y * delta, lagrange**2 * powers]
            u, bar_u, n = new_u, new_bar, behind
        one, two, three, four = -sums / GREEN  # a positive W is a longer path here, and a wavefront ahead in the book
        return one / 8, two / 2, three / 2, (three + four) / 4

    def test_feature_coddingtons_formulas_off_the_axis(self):
        """Curvature of the path over the stop: that of a star's wave and that of the image point's, traced back."""
        radius, thickness, height = 25e-3, 3e-3, 6e-3
        given = system(plano_convex(radius, thickness), 50.0, math.inf)
        step = 1e-2
        points = np.array([[step, 0.0], [-step, 0.0], [0.0, step], [0.0, -step]])
        found = wavefronts(given, GREEN, np.array([height]), np.array([0.0]), points).path[0, 0]
        curved = [found[:2].sum() / (step * given.stop_radius) ** 2, found[2:].sum() / (step * given.stop_radius) ** 2]
        sine = self.chief_sine(given, thickness, height)
        inner = math.asin(sine / INDEX)
        outer = math.asin(sine)
        # Back from the image point: to the plane, through the glass, through the front surface at its vertex.
        distance = (given.sensor_z - thickness) / math.cos(outer)
        sagittal, tangential = distance * INDEX, distance * INDEX * (math.cos(inner) / math.cos(outer)) ** 2
        within = thickness / math.cos(inner)
        sagittal, tangential = sagittal + within, tangential + within
        power = (INDEX * math.cos(inner) - math.cos(outer)) / radius
        front_s = power - INDEX / sagittal
        front_t = (power - INDEX * math.cos(inner) ** 2 / tangential) / math.cos(outer) ** 2
        expected = [-front_t * math.cos(outer) ** 2, -front_s]
        assert curved == pytest.approx(expected, rel=1e-3)

    @staticmethod
    def chief_sine(given, thickness, height):
        """Sine of the angle of the ray from the vertex of the first surface, in air, to a height on the sensor."""
        from scipy.optimize import brentq

        def landing(sine):
            inner = math.asin(sine / INDEX)
            return thickness * math.tan(inner) + (given.sensor_z - thickness) * math.tan(math.asin(sine)) - height

        return brentq(landing, 0.0, 0.9, xtol=1e-15)

    def test_feature_a_symmetric_lens_at_unit_size_has_no_coma_or_distortion(self):
        focus = 2 * first_order(Prescription.read(symmetric_pair()), 8.0, math.inf).focal_length
        given = first_order(Prescription.read(symmetric_pair()), 8.0, focus)
        traced = wavefronts(given, GREEN, np.array([4e-3]), np.array([0.0]), np.array([[0.8, 0.0], [-0.8, 0.0]]))
        assert abs(float(traced.path[0, 0, 0] - traced.path[0, 0, 1])) < 1e-12
        for wavelength in (500e-9, 650e-9):
            chief = wavefronts(given, wavelength, np.array([4e-3]), np.array([0.0]), np.array([[0.8, 0.0]])).chief
            assert float(chief[0, 0]) == pytest.approx(4e-3, abs=2e-9)

    def test_feature_rims_cut_the_stop_in_discs(self):
        """Paraxially a rim of radius r at a distance d from the stop is a disc of that radius, moved by the slope."""
        given = {
            "surfaces": [
                {"kind": "stop", "t": 20e-3},
                {"R": None, "t": 1e-6, "glass": "glass", "r": 3e-3},
                {"R": -25e-3, "t": 0.0},
            ],
            "index": {"glass": INDEX},
        }
        lens = Lens.from_prescription(given, 10.0, math.inf, wavelengths=(GREEN,), field=5e-3, nearest=1.0)
        edges = lens.sample(torch.tensor([5e-3]), torch.tensor([0.0]), GREEN).edges[0]
        tangent = float(lens.table.slopes(torch.tensor([5e-3]), torch.tensor([0.0]))) * 5e-3
        radius = first_order(Prescription.read(given), 10.0, math.inf).stop_radius
        expected = [[-20e-3 * tangent / radius, 3e-3 / radius]]
        self.assert_close(edges, torch.tensor(expected, dtype=torch.float64), rtol=1e-2, atol=1e-3)

    def test_feature_two_discs_have_the_area_of_a_lens_shape(self):
        edges, rule = np.linspace(-1.15, 1.15, 24), np.polynomial.legendre.leggauss(8)
        for away, radius in ((0.7, 1.0), (1.1, 0.6), (0.2, 0.75)):
            discs = np.array([[0.0, 0.0, 1.0], [away * 0.6, away * 0.8, radius]])
            found = float(stop_quadrature(np.stack([edges[:-1], edges[1:]]), rule, discs).weight.sum())
            if away <= 1 - radius:
                expected = math.pi * radius**2
            else:
                one = math.acos((away**2 + 1 - radius**2) / (2 * away))
                other = math.acos((away**2 + radius**2 - 1) / (2 * away * radius))
                expected = one - math.sin(2 * one) / 2 + radius**2 * (other - math.sin(2 * other) / 2)
            assert found == pytest.approx(expected, abs=1e-7)

    def test_feature_a_pinhole_scene_darkens_with_the_fourth_power_of_the_cosine(self):
        """A stop far in front of a weak lens: the light falls off as in a pinhole camera."""
        lens = Lens.from_seidel(50e-3, 8.0, 1.0, 10e-3)
        assert float(lens.relative_illumination(torch.tensor([10e-3]))) == pytest.approx(1.0)
        single = Lens.from_prescription(
            plano_convex(250e-3, 1e-3), 60.0, math.inf, wavelengths=(GREEN,), field=0.1, nearest=30.0
        )
        cosine = math.cos(math.atan(0.1 / single.focal_length))
        assert float(single.relative_illumination(torch.tensor([0.1]))) == pytest.approx(cosine**4, rel=1e-2)

    def test_feature_seidel_coefficients_are_the_wavefront(self):
        lens = Lens.from_seidel(50e-3, 8.0, 1.0, 10e-3, spherical=1.0, coma=2.0, astigmatism=-0.5, field_curvature=0.3)
        x, y, h = torch.tensor([0.3, -0.7]).double(), torch.tensor([0.5, 0.1]).double(), 0.6
        r2 = x**2 + y**2
        expected = r2**2 + 2 * h * r2 * x + h**2 * (-0.5 * x**2 + 0.3 * r2) + 5.0 / (2 * math.pi) * r2
        self.assert_close(path(lens, 6e-3, 5.0, x, y) / (2 * math.pi), expected, atol=1e-6, rtol=0)
        assert float(Lens.from_seidel(50e-3, 8, 1.0, 10e-3, distortion=-0.02).distortion(torch.tensor([10e-3]))) == (
            pytest.approx(-0.02, abs=2**-22)  # a table holds float32
        )

    @pytest.mark.parametrize(
        ("order", "columns", "function"),
        [
            ("noll", {"Z4": 1.0}, lambda x, y: math.sqrt(3) * (2 * (x**2 + y**2) - 1)),
            ("noll", {"Z7": 1.0}, lambda x, y: math.sqrt(8) * (3 * (x**2 + y**2) - 2) * y),
            ("noll", {"Z11": 1.0}, lambda x, y: math.sqrt(5) * (6 * (x**2 + y**2) ** 2 - 6 * (x**2 + y**2) + 1)),
            ("fringe", {"Z4": 1.0}, lambda x, y: 2 * (x**2 + y**2) - 1),
            ("fringe", {"Z8": 1.0}, lambda x, y: (3 * (x**2 + y**2) - 2) * y),
            ("fringe", {"Z9": 1.0}, lambda x, y: 6 * (x**2 + y**2) ** 2 - 6 * (x**2 + y**2) + 1),
        ],
    )
    def test_feature_zernike_tables_in_both_orders(self, tmp_path, order, columns, function):
        """Noll (1976), table I; fringe: Wyant and Creath (1992), table III. Their x and y are the file's."""
        lines = [f"field_mm,wavelength_nm,{','.join(columns).replace('Z', 'Z0')}"]
        lines += [
            f"{h},{w},{','.join(str(value * h / 10) for value in columns.values())}"
            for h in (0, 5, 10)
            for w in (500, 600)
        ]
        (tmp_path / "lens.csv").write_text("# a comment\n" + "\n".join(lines))
        lens = Lens.from_zernike_table(tmp_path / "lens.csv", 50e-3, 8.0, 1.0, order=order, sign=1)
        u, v = torch.tensor([0.3, -0.7]).double(), torch.tensor([0.5, 0.1]).double()
        found = path(lens, 10e-3, 0.0, v, -u, 600e-9) / (2 * math.pi) * 530 / 600  # the field lies along the file's +y
        self.assert_close(found, function(u, v), atol=1e-6, rtol=0)

    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("field_mm,Z4\n", "must have a line of names and one or more of numbers, got 1 lines"),
            ("Z4\n1\n", "columns between commas, field_mm among them and each once, got Z4"),
            ("field_mm,Z4,Z04\n1,1,1\n", "Z1 to Z91 once, got 'Z04'"),
            ("field_mm,Q\n1,1\n", "must be field_mm, wavelength_nm and Z1 to Z91 once, got 'Q'"),
            ("field_mm,Z99\n1,1\n", "must be field_mm, wavelength_nm and Z1 to Z91 once, got 'Z99'"),
            ("field_mm\n1\n", "must have columns of coefficients such as Z4, got field_mm"),
            ("field_mm,Z4\n1\n", "line 2 of .* must have 2 values, got 1"),
            (f"field_mm,Z4\n1,{'9' * 200_000}\n", "cannot read .*: field larger than field limit"),
            ("field_mm,Z4\n1,blue\n", "Z4 in line 2 of .* must be a finite number, got 'blue'"),
            ("field_mm,Z4\n1,1\n1,2\n", "must have each field once for each wavelength"),
            ("field_mm,Z8\n1,1\n", "must be 0, as of a lens of revolution with fields along .y, got 1 for Z8"),
            ("# a\n\nfield_mm,Z4\n1,blue\n", "Z4 in line 4 of .* must be a finite number, got 'blue'"),
            ("field_mm,Z\uff14\n1,1\n", "must be field_mm, wavelength_nm and Z1 to Z91 once, got 'Z\uff14'"),
            ("field_mm,Z4\n" + "0,1\n" * 20_000, "got 20001 lines of 2 to 20000"),
            ("field_mm,Z7\n0,0.2\n1,0.3\n", "0 on its axis, got 0.2 for Z7 at field_mm 0"),
            ("field_mm,Z4\n5,1\n", "must have two fields or more for each wavelength, .* got 5 at 530 nm"),
            ("field_mm,wavelength_nm,Z4\n0,470,1\n5,470,1\n0,610,1\n3,610,1\n", "largest of 5 mm, got 0, 3 at 610 nm"),
            ("field_mm,Z4\n-1,1\n", "field_mm of .* must be from 0 to 1000, got -1"),
            ("field_mm,wavelength_nm,Z4\n1,0.53,1\n", "wavelength_nm of .* must be from 100 to 20000, got 0.53"),
        ],
    )
    def test_exception_zernike_tables(self, tmp_path, text, message):
        (tmp_path / "lens.csv").write_text(text, encoding="utf-8")
        with pytest.raises(ValueError, match=message) as raised:
            Lens.from_zernike_table(tmp_path / "lens.csv", 50e-3, 8.0, 1.0)
        assert "\n" not in str(raised.value)

    def test_feature_files_pickles_copies_and_states_hold_the_lens(self, tmp_path):
        lens = Lens.from_prescription(symmetric_pair(), 8.0, 0.5, wavelengths=(GREEN, 600e-9), field=5e-3)
        lens.save(tmp_path / "a.lens")
        assert (tmp_path / "a.lens").stat().st_size < 60_000
        empty = Lens.from_seidel(lens.focal_length, 8.0, 0.5, 5e-3)
        empty.load_state_dict(lens.state_dict())
        x, y = torch.tensor([0.3, -0.7]).double(), torch.tensor([0.5, 0.1]).double()
        expected = path(lens, 3e-3, 2.0, x, y)
        for other in (Lens.load(tmp_path / "a.lens"), pickle.loads(pickle.dumps(lens)), copy.deepcopy(lens), empty):
            self.assert_close(path(other, 3e-3, 2.0, x, y), expected, atol=1e-4, rtol=0)  # radians, in float32
            assert (other.focal_length, other.f_number) == (lens.focal_length, 8.0)

    def test_feature_beyond_its_range_its_edge_stands_in_and_it_warns(self):
        lens = Lens.from_seidel(50e-3, 8.0, 1.0, 10e-3, coma=1.0)
        x, y = torch.tensor([0.3]).double(), torch.tensor([0.5]).double()
        with pytest.warns(LensRangeWarning, match=r"a field of 0.02 m beyond 0.01 m, and the edge of its table"):
            beyond = path(lens, 20e-3, 0.0, x, y)
        self.assert_close(beyond, path(lens, 10e-3, 0.0, x, y))
        with pytest.warns(LensRangeWarning, match=r"a defocus of 1000 rad beyond .* and a wavelength of 800 nm beyond"):
            lens.sample(torch.tensor([0.0]), torch.tensor([1000.0]), 800e-9)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            lens.sample(torch.tensor([10e-3]), torch.tensor([0.0]), 500e-9)

    def test_feature_its_camera_is_the_thin_lens_of_its_lengths(self):
        lens = Lens.from_seidel(35e-3, 5.6, 2.0, 10e-3)
        camera = lens.camera(6e-6)
        assert isinstance(camera, ThinLensCamera)
        assert (camera.focal_length, round(camera.f_number, 9), camera.focus_distance) == (35e-3, 5.6, 2.0)

    def test_feature_wavefronts_between_wavelengths_are_those_of_a_lens_traced_there(self):
        known, traced = (Lens.named("triplet-50mm", 8.0, 0.595, waves) for waves in (RGB, (495e-9, 575e-9, *RGB)))
        for wavelength in (495e-9, 575e-9):
            given = torch.tensor([0.0, 6e-3]), torch.tensor([-15.0, 10.0]), wavelength
            own, there = (lens.sample(*given).wavefront[..., 1:] for lens in (known, traced))
            count = min(own.shape[-1], there.shape[-1])
            error = torch.linalg.vector_norm(own[..., :count] - there[..., :count], dim=-1).max() / (2 * math.pi)
            assert float(error) < 1e-3  # waves rms; polynomials over the wavelength itself are .003 off

    @pytest.mark.parametrize(
        ("call", "message"),
        [
            (lambda: Lens.named("sonnar", 8.0, 0.5), "must be one of 'double-gauss-50mm', .*, got 'sonnar'"),
            (lambda: Lens.named("single-50mm", 0.3, 0.5), "f_number must be at least 0.5, got 0.3"),
            (lambda: Lens.named("single-50mm", -1, 0.5), "f_number must be positive and finite, got -1"),
            (lambda: Lens.named("single-50mm", 8, 0.03), "focus_distance must be one that the lens brings to a sensor"),
            (lambda: Lens.named("single-50mm", 8, -0.5), "focus_distance must be positive metres, got -0.5"),
            (lambda: Lens.named("single-50mm", 8, 0.5, wavelengths=(530,)), "wavelengths must be metres between"),
            (lambda: Lens.named("single-50mm", 8, 0.5, field=6.8), "field must be metres between 1e-06 and 1"),
            (lambda: Lens.named("single-50mm", 8, 0.5, field=0.2), "no ray through the stop at .* reaches the sensor"),
            (lambda: Lens.from_prescription(plano_convex(), 8.0, 0.5), "field must be the largest height on"),
            (lambda: Lens.from_prescription(plano_convex(25.0), 8.0, 0.5, field=0), "give it 'unit': 'mm'"),
            (lambda: Lens.from_prescription(plano_convex(index={"powers": [[-2, 0]]}), 8.0, 0.5, field=0), "gives nan"),
            (lambda: SEIDEL.distortion(torch.tensor([-1e-3])), "heights must be zero or positive metres .*-0.001"),
            (lambda: SEIDEL.relative_illumination(torch.zeros(2, 2)), "heights must be zero or positive metres"),
            (lambda: Lens.from_prescription(plano_convex(-25e-3), 8.0, 0.5, field=0), "the lens must collect light"),
            (lambda: Lens.from_seidel(50e-3, 8.0, 1.0, 1e-2, coma=math.nan), "coma must be finite .*, got nan"),
            (lambda: Lens.from_seidel(50e-3, 8.0, 1.0, 1e-2, distortion=2), "distortion must be a part of 1"),
        ],
    )
    def test_exception_names_value_and_what_is_allowed(self, call, message):
        with pytest.raises(ValueError, match=message) as raised:
            call()
        assert "\n" not in str(raised.value)

    @pytest.mark.parametrize(
        ("call", "message"),
        [
            (lambda: Lens.named("single-50mm", [8], 0.5), "f_number must be a number, got a list"),
            (lambda: Lens.named("single-50mm", 8, 0.5, wavelengths=530e-9), "wavelengths must be one or more numbers"),
            (lambda: Lens.from_prescription(5, 8.0, 0.5), "prescription must be a mapping, got the number 5"),
            (lambda: Lens.from_seidel(50e-3, 8.0, 1.0, 1e-2, coma=np.ones(2)), "coma must be a number, got a ndarray"),
            (lambda: SEIDEL.lateral_colour(1e-3, 530e-9), "heights must be a tensor .*, got the number 0.001"),
        ],
    )
    def test_exception_of_types(self, call, message):
        with pytest.raises(TypeError, match=message):
            call()

    def test_exception_files_that_are_no_lens(self, tmp_path):
        from safetensors.torch import save_file

        save_file({"phase": torch.ones(2)}, tmp_path / "a")
        with pytest.raises(ValueError, match=r"a is not a lens: it is .* with \['phase'\]"):
            Lens.load(tmp_path / "a")
        lens = Lens.from_seidel(50e-3, 8.0, 1.0, 10e-3)
        with pytest.raises(ValueError, match="cannot read the lens in the state: it is damaged"):
            lens.set_extra_state(lens.get_extra_state()[:100])


@pytest.mark.takes_seconds
class TestAgainstReference(BaseTester):
    """Wavefronts of an independent tracer, which agrees with three optical programs."""

    @pytest.mark.parametrize(
        ("file", "name", "f_number", "bound", "key"),
        [
            ("single_f17.6", "single-50mm", 17.6, 2e-3, "W"),
            ("double_gauss_f17.6", "double-gauss-50mm", 17.6, 2e-3, "W"),
            ("double_gauss_f8.0", "double-gauss-50mm", 8.0, 6e-3, "W"),
            ("triplet_f8.0", "triplet-50mm", 8.0, 2e-3, "W"),
            ("phone_f5.6", "phone-5.5mm", 5.6, 9e-3, "W_joined"),
        ],
    )
    def test_feature_wavefronts(self, file, name, f_number, bound, key):
        """Those of 50 mm lenses are on a sphere, which joined rays differ from by up to .0057 waves at f/8."""
        known = np.load(shared(f"lenses/opd_{file}.npz"))
        focus = 0.6 if name.startswith("phone") else 0.595
        lens = Lens.named(name, f_number, focus)
        grid = torch.from_numpy(known["grid"])
        v, u = torch.meshgrid(grid, grid, indexing="ij")
        inside = u**2 + v**2 <= 1 + 1e-12
        worst = 0.0
        for c, wavelength in enumerate((470e-9, 530e-9, 610e-9)):
            for f in range(4):  # fields along +y
                for d, psi in enumerate(known["psi"]):
                    found = path(lens, known["fields"][f, 0] * 1e-3, float(psi), v[inside], -u[inside], wavelength)
                    reference = torch.from_numpy(known[key][d, f, c]).double()[inside]
                    error = found / (2 * math.pi) * 530e-9 / wavelength - reference
                    worst = max(worst, float(error.square().mean().sqrt()))
        assert worst < bound
        assert lens.residual < (9e-3 if name.startswith("phone") else 2e-3)

    def test_feature_vignetting_of_a_fast_lens(self):
        known = np.load(shared("lenses/vignetting.npz"))
        lens = Lens.named("double-gauss-50mm", 1.8, 0.595, wavelengths=(GREEN,), field=21.6e-3)
        grid = torch.from_numpy(known["grid"])
        v, u = torch.meshgrid(grid, grid, indexing="ij")
        inside = u**2 + v**2 <= 1
        sample = lens.sample(torch.from_numpy(known["heights"]) * 1e-3, torch.tensor([0.0]), GREEN)
        for f, fraction in enumerate(known["fraction"][0]):
            lit = inside.clone()
            for centre, radius in sample.edges[f].tolist():
                lit &= (v - centre) ** 2 + u**2 <= radius**2
            assert float(lit.sum() / inside.sum()) == pytest.approx(float(fraction), abs=4e-3)
