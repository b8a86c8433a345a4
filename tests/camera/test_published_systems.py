"""Published systems: values against their sources, expected physics, and the cameras built from them."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from kornia_tidy import DefocusRange, NoMask, PixelwiseMask, TiDyOptics
from kornia_tidy.camera.published_systems import single_element
from kornia_tidy.design.fisher_information import defocus_bound, defocus_response, fisher_information
from kornia_tidy.optics import SYSTEMS, published_system
from kornia_tidy.psf import AliasingWarning
from tests.base import BaseTester

NAMES = list(SYSTEMS)
HIDING = [name for name in NAMES if SYSTEMS[name].compositing == "occlusion"]


def preset(name, **overrides):
    return TiDyOptics.from_preset(name, generator=torch.Generator().manual_seed(0), **overrides)


def psfs(optics, defocus):
    with torch.no_grad():
        return optics.psf_bank(defocus=defocus).psfs


def sharpest(optics, defocus, channel=1):
    """Return the defocus at which the peak of the PSF is highest."""
    return defocus[int(psfs(optics, defocus)[:, channel].amax((1, 2)).argmax())]


class TestSources(BaseTester):
    """The table against numbers of the sources, which are written out here again."""

    @pytest.mark.parametrize(
        ("name", "focal_length", "f_number", "focus", "pitch", "depths"),
        [
            ("phasecam3d", 50e-3, 17.64, 0.85, 7.36e-6, (0.496, 2.969)),
            ("ikoma2021", 50e-3, 6.3, 1.7, 6.45e-6, (1.0, 5.0)),
            ("sitzmann2018", 34.28e-3, 6.852, 1.0, 3.69e-6, (0.5, 1000.0)),
            ("tidy-5", 50e-3, 17.65, 0.595, 7.56e-6, (0.2975, math.inf)),
        ],
    )
    def test_feature_lenses(self, name, focal_length, f_number, focus, pitch, depths):
        camera = SYSTEMS[name].camera()
        assert camera.focal_length == pytest.approx(focal_length, rel=1e-3)
        assert camera.f_number == pytest.approx(f_number, rel=1e-3)
        assert camera.focus_distance == pytest.approx(focus, rel=1e-9)
        assert camera.pixel_pitch == pytest.approx(pitch, rel=1e-3)
        assert camera.depth_range == pytest.approx(depths, rel=1e-3)

    def test_feature_colours_noise_and_compositing(self):
        nanometres = {name: tuple(round(w * 1e9) for w in s.spectrum.wavelengths) for name, s in SYSTEMS.items()}
        assert nanometres["tidy-5"] == nanometres["phasecam3d"] == (610, 530, 470)
        assert nanometres["ikoma2021"] == (632, 550, 450)
        assert nanometres["sitzmann2018"] == (640, 550, 460)
        sigmas = {name: preset(name).sensor.sigma for name in ("phasecam3d", "ikoma2021", "sitzmann2018")}
        assert sigmas == {"phasecam3d": 0.01, "ikoma2021": 0.003, "sitzmann2018": 0.0105}
        assert set(HIDING) == {"ikoma2021", "liu2022-pixelwise", "liu2022-spiral"}
        material = preset("sitzmann2018").masks.material
        assert [round(material.index(w * 1e-9), 6) for w in (460, 550, 640)] == [1.499, 1.493, 1.488]

    def test_feature_masks(self):
        assert {name: tuple(preset(name).masks.phase.shape) for name in ("tidy-5", "tidy-1", "phasecam3d")} == {
            "tidy-5": (5, 23, 23),
            "tidy-1": (1, 23, 23),
            "phasecam3d": (1, 23, 23),
        }
        heights = preset("tidy-5").masks.heights().detach()
        assert 0 <= float(heights.min()) < 1e-8
        assert 1.19e-6 < float(heights.max()) <= 1.2e-6
        modes = {name: preset(name).masks.coefficients.shape[1] for name in ("phasecam3d", "sitzmann2018")}
        assert modes == {"phasecam3d": 55, "sitzmann2018": 350}

    def test_feature_a_designed_mask_has_the_bound_that_is_told(self):
        response = defocus_response(preset("phasecam3d").psf_model, [float(psi) for psi in range(-10, 11, 2)])
        bound = defocus_bound(fisher_information(response, photons=3000, background=5)).mean().detach()
        assert float(bound) == pytest.approx(0.0353, rel=5e-3)

    def test_convention_a_guess_says_so_first(self):
        for system in SYSTEMS.values():
            assert {"compositing", "noise", "wavelengths", "masks", "index", "pixels"} <= set(system.sources)
            for name, source in system.sources.items():
                assert ": " in source or name in ("start", "index", "pixels"), (system.name, name)
                assert ("guess" in source) == source.startswith("guess: "), (system.name, name)
        assert SYSTEMS["ikoma2021"].guesses == ("start",)
        assert "focal length" in SYSTEMS["chang2019"].guesses

    def test_feature_the_paper_fidelity_is_the_published_system(self):
        """PSFs against NumPy: a 23-point pupil, FFTs of 31, 27 and 23 points, cropped to 23."""
        with pytest.warns(AliasingWarning):
            optics = preset("tidy-5", fidelity="paper", camera=DefocusRange(-20, 20))
        assert optics.defocus_nodes == pytest.approx(np.linspace(-20, 20, 21), abs=1e-12)
        assert (optics.compositing, optics.color_space, optics.fidelity.correlate) == ("gather", "paper", True)
        x = np.linspace(-1.1, 1.1, 23)
        rho2 = x[:, None] ** 2 + x**2
        heights = optics.masks.heights().detach().double().numpy()
        bank = psfs(optics, [-14.0, 0.0, 6.0]).double().numpy()
        for channel, (size, wavelength) in enumerate(((31, 610e-9), (27, 530e-9), (23, 470e-9))):
            for d, psi in enumerate((-14.0, 0.0, 6.0)):
                angle = 2 * np.pi / wavelength * 0.5 * heights + psi * rho2 * 530e-9 / wavelength
                field = np.where(rho2 <= 1 + 1e-9, np.exp(1j * angle), 0)
                light = np.abs(np.fft.fftshift(np.fft.fft2(field, (size, size)), (1, 2))) ** 2
                margin = (size - 23) // 2
                light = light[:, margin : margin + 23, margin : margin + 23].mean(0) / (size**2 * 317)
                assert abs(light - bank[d, channel]).max() < 1e-6 * light.max()


class TestPhysics(BaseTester):
    def test_feature_changs_colours_are_sharp_where_the_glass_says(self):
        """The power of a single lens goes as n - 1: PMMA has 1.49163, 1.49539, 1.49970 (610, 530, 470 nm)."""
        optics, nodes = preset("chang2019"), [psi / 2 for psi in range(-46, 47)]
        scale = math.pi * 3.125e-3**2 / 530e-9 / 50e-3
        for channel, index in enumerate((1.49163, 1.49539, 1.49970)):
            expected = scale * ((index - 1) / 0.49539 - 1)  # red is in focus farther away, blue nearer
            assert sharpest(optics, nodes, channel) == pytest.approx(expected, abs=0.5)


class TestFromPreset(BaseTester):
    def test_exception_an_unknown_name_lists_those_there_are(self):
        with pytest.raises(ValueError, match=r"must be one of 'tidy-5', 'tidy-1', .*'sitzmann2018', got 'tidy'"):
            TiDyOptics.from_preset("tidy")

    def test_exception_an_unknown_argument(self):
        with pytest.raises(TypeError, match="unexpected keyword argument 'mask'"):
            preset("tidy-1", mask=None)

    def test_feature_overrides_replace_parts_and_nothing_else(self):
        optics = preset("ikoma2021", masks=PixelwiseMask(2, (30, 40)), sensor=None)
        assert optics.pupil.amplitude.shape == (30, 30)  # the iris follows the pixels of the mask's shorter side
        assert optics.sensor is None
        assert (optics.compositing, optics.camera.focus_distance) == ("occlusion", 1.7)
        assert preset("tidy-1", masks=None).masks.phase.shape == (1, 23, 23)

    def test_smoke_a_system_is_found_by_its_name(self):
        assert all(published_system(name).name == name for name in NAMES)
        assert len(NAMES) == 9
        assert [SYSTEMS[name].year for name in NAMES] == [2023, 2023, 2023, 2019, 2021, 2019, 2022, 2022, 2018]


class TestSingleElement(BaseTester):
    @pytest.mark.parametrize("name", ["chang2019", "sitzmann2018"])
    def test_feature_astigmatism_and_field_curvature_are_those_of_a_thin_lens(self, name):
        """With the stop in contact: S_III = H^2 / f and S_IV = S_III / n. The element is 3 mm thick: within a tenth."""
        lens, camera = single_element(SYSTEMS[name]), SYSTEMS[name].camera()
        heights = torch.tensor([0.0, 5e-3], dtype=torch.float64)
        axis, corner = lens.sample(heights, torch.zeros(1, dtype=torch.float64), 530e-9).wavefront[:, 0]
        invariant = camera.aperture_radius * 5e-3 / float(camera.image_distance)
        third = invariant**2 / camera.focal_length * 2 * math.pi / 530e-9  # S_III in radians
        index = camera.lens_material.index(530e-9)
        assert float(corner[3]) == pytest.approx(-third / 4 / math.sqrt(6), rel=0.1)  # of sqrt(6) rho^2 cos 2 phi
        curvature = -third / 4 * (2 + 1 / index)  # of rho^2, of both
        assert float(corner[2] - axis[2]) == pytest.approx(curvature / (2 * math.sqrt(3)), rel=0.1)

    @pytest.mark.parametrize("name", ["chang2019", "sitzmann2018"])
    def test_feature_colours_lie_as_far_apart_in_focus_as_by_the_material(self, name):
        given = {"masks": NoMask(46), "fidelity": "draft", "sensor": None}
        real, ideal = preset(name, lens="own", **given), preset(name, **given)
        foci = [torch.tensor([sharpest(optics, range(-20, 22), c) for c in (0, 1, 2)]) for optics in (real, ideal)]
        apart = [(own - own[1]).double() for own in foci]
        self.assert_close(apart[0], apart[1], rtol=0, atol=1.0)
        assert float(apart[1].abs().max()) > 5

    def test_feature_it_is_the_camera_of_the_system_in_all_else(self):
        real, ideal = preset("chang2019", lens="own"), preset("chang2019")
        assert real.lens.name == "chang2019"
        assert real.camera.lens_material is None
        for name in ("focal_length", "f_number", "focus_distance", "pixel_pitch", "depth_range", "defocus_range"):
            assert getattr(real.camera, name) == pytest.approx(getattr(ideal.camera, name), rel=1e-6)
        image, depth = torch.rand(1, 3, 24, 24), torch.full((1, 1, 24, 24), 2.0)
        assert bool(real(image, depth).isfinite().all())

    def test_exception_a_system_that_is_no_single_element(self):
        with pytest.raises(ValueError, match="the single elements chang2019 and sitzmann2018, got 'tidy-5'"):
            preset("tidy-5", lens="own")
