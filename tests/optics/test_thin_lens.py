from __future__ import annotations

import math

import pytest
import torch

from kornia_tidy import DefocusRange, Fidelity, PixelwiseMask, ThinLensCamera
from kornia_tidy.optics import FUSED_SILICA, PMMA, Spectrum, thin_lens_defocus
from kornia_tidy.psf import PSFModel
from tests.base import BaseTester


class TestThinLensDefocus(BaseTester):
    def test_feature_focus_is_zero_and_infinity_is_exact(self, device, dtype):
        camera = ThinLensCamera()
        psi = camera.defocus(torch.tensor([0.595, math.inf], device=device, dtype=dtype))
        scale = math.pi * 1.4175e-3**2 / 530e-9
        self.assert_close(psi, torch.tensor([0.0, -scale / 0.595], device=device, dtype=dtype), atol=2e-6)

    def test_feature_matches_the_exact_path_difference(self, device):
        """Against the path sqrt(z^2 + r^2) - z, to the relative error R^2/4 (1/z^2 + 1/(z z_f) + 1/z_f^2)."""
        radius, focus = 1.4175e-3, 0.595
        z = torch.tensor([0.2975, 0.4, 0.8, 3.0, 1e3], device=device, dtype=torch.float64)
        path = (z.square() + radius**2).sqrt() - z - (math.sqrt(focus**2 + radius**2) - focus)
        exact = 2 * math.pi / 530e-9 * path
        psi = thin_lens_defocus(z, radius, focus)
        bound = radius**2 / 4 * (1 / z.square() + 1 / (z * focus) + 1 / focus**2)
        assert bool(((psi - exact).abs() <= bound * psi.abs() + 1e-6).all())

    @pytest.mark.parametrize("depth", [1e-42, 1e-30, 1e-6, 1.0, 1e12, 3e38, float("inf")])
    def test_feature_defocus_and_its_gradient_are_finite_where_it_is_clamped(self, depth):
        """The square of an inverse depth overflows, and is multiplied by the 0 of the clamp: NaN."""
        leaf = torch.tensor([depth], requires_grad=True)
        defocus = thin_lens_defocus(leaf, 1.4175e-3, 0.595)
        defocus.clamp(-20, 20).sum().backward()
        assert bool(defocus.isfinite().all())
        assert bool(leaf.grad.isfinite().all())

    def test_gradcheck_depth_and_focus(self):
        self.gradcheck(lambda z, f: thin_lens_defocus(z, 1.4e-3, f), (torch.tensor([0.3, 0.9]), torch.tensor(0.6)))


class TestThinLensCamera(BaseTester):
    def test_feature_default_spans_the_range_of_the_paper(self):
        lo, hi = ThinLensCamera().defocus_range
        assert lo == pytest.approx(-20.02, abs=5e-3)
        assert hi == pytest.approx(-lo)

    @pytest.mark.parametrize("depth_range", [(0.3, math.inf), (0.5, 4.0)])
    def test_feature_depth_is_the_inverse_of_defocus_and_infinity_is_exact(self, depth_range, dtype):
        if dtype not in {torch.float32, torch.float64}:
            pytest.skip("half precision rounds defocus by hundredths of a radian")
        camera = ThinLensCamera.for_scene(depth_range)
        depth = torch.tensor([*depth_range, 0.7, 1.3, 3.0], dtype=dtype)
        assert camera.depth(camera.defocus(depth)).dtype == dtype
        torch.testing.assert_close(camera.depth(camera.defocus(depth)), depth, rtol=1e-5, atol=0)
        beyond = camera.depth(torch.tensor([-60.0], dtype=dtype))
        assert beyond.isinf().all()

    def test_feature_depth_follows_a_focus_that_has_moved(self):
        camera = ThinLensCamera(focus_distance=torch.tensor(0.6, dtype=torch.float64))
        with torch.no_grad():
            camera.focus_distance.fill_(0.75)
        depth = torch.tensor([0.4, 0.9, 5.0], dtype=torch.float64)
        torch.testing.assert_close(camera.depth(camera.defocus(depth)).detach(), depth, rtol=1e-9, atol=0)

    def test_feature_resized_keeps_the_lens(self):
        camera = ThinLensCamera(depth_range=(0.3, 4.0)).resized(0.25)
        assert camera.pixel_pitch == 32e-6
        assert (camera.f_number, camera.depth_range) == (ThinLensCamera().f_number, (0.3, 4.0))

    @pytest.mark.parametrize(
        ("depths", "psis"), [((0.5, 10.0), (-20, 20)), ((1.0, math.inf), (-15, 5)), ((2.0, 9.0), (0, 30))]
    )
    def test_feature_for_scene_puts_the_depths_on_the_range(self, depths, psis):
        camera = ThinLensCamera.for_scene(depths, psis)
        psi = camera.defocus(torch.tensor(depths, dtype=torch.float64))
        self.assert_close(psi, torch.tensor(psis[::-1]), rtol=1e-9, atol=1e-9)
        assert camera.defocus_range == pytest.approx(psis)

    def test_feature_a_learnable_focus_gets_gradients_and_keeps_its_range(self):
        camera = ThinLensCamera(focus_distance=torch.tensor(0.595))
        camera.defocus(torch.tensor([0.4, 2.0])).sum().backward()
        assert camera.focus_distance.grad is not None
        before = camera.defocus_range
        with torch.no_grad():
            camera.focus_distance.add_(0.1)
        assert camera.defocus_range == before

    @pytest.mark.parametrize("depth", [0.0, -1.0, math.nan])
    def test_exception_names_the_bad_depth(self, depth, device, dtype):
        with pytest.raises(ValueError, match=f"depth must be positive metres, got {depth}"):
            ThinLensCamera().defocus(torch.tensor([1.0, depth], device=device, dtype=dtype))

    @pytest.mark.parametrize(
        "options",
        [
            {"focal_length": 0.0},
            {"aperture_diameter": -1e-3},
            {"pixel_pitch": math.nan},
            {"focus_distance": 0.05},
            {"focus_distance": math.inf},
            {"depth_range": (1.0, 0.5)},
            {"depth_range": (0.0, 0.5)},
        ],
    )
    def test_exception_impossible_lens(self, options):
        with pytest.raises(ValueError, match=r"must be|needs depth_range"):
            ThinLensCamera(**options)

    def test_exception_for_scene_ranges(self):
        with pytest.raises(ValueError, match="depth_range must be"):
            ThinLensCamera.for_scene((2.0, 1.0))
        with pytest.raises(ValueError, match="defocus_range must be"):
            ThinLensCamera.for_scene((1.0, 2.0), (5.0, 20.0))

    def test_feature_focus_at_infinity_works_with_a_depth_range(self):
        camera = ThinLensCamera(focus_distance=math.inf, depth_range=(1.0, math.inf))
        assert camera.image_distance == camera.focal_length
        assert camera.defocus_range[0] == 0.0

    @pytest.mark.parametrize("focal_length", [35e-3, 50e-3])
    def test_feature_an_f_number_is_the_focal_length_over_the_diameter(self, focal_length):
        camera = ThinLensCamera(focal_length, f_number=8)
        assert camera.aperture_diameter == pytest.approx(focal_length / 8, rel=1e-15)
        assert camera.defocus_range == ThinLensCamera(focal_length, focal_length / 8).defocus_range
        assert camera.resized(0.5).f_number == pytest.approx(8, rel=1e-15)

    @pytest.mark.parametrize(
        ("options", "sentence"),
        [
            ({"f_number": 8, "aperture_diameter": 5e-3}, "got both: 0.005 and 8"),
            ({"f_number": 0}, "f_number must be"),
            ({"f_number": float("nan")}, "f_number must be"),
            ({"f_number": 0.4}, "f_number must be at least 0.5"),
        ],
    )
    def test_exception_f_number(self, options, sentence):
        with pytest.raises(ValueError, match=sentence):
            ThinLensCamera(**options)


class TestDefocusRange(BaseTester):
    def test_feature_maps_disparity_linearly(self, device, dtype):
        disparity = torch.rand(2, 1, 3, 4, device=device, dtype=dtype)
        self.assert_close(DefocusRange(-8, 4).defocus(disparity), -8 + 12 * disparity)

    @pytest.mark.parametrize("value", [-0.1, 1.1, math.nan])
    def test_exception_outside_the_unit_interval(self, value):
        with pytest.raises(ValueError, match="normalised disparity in"):
            DefocusRange().defocus(torch.tensor([0.5, value]))

    def test_exception_empty_range(self):
        with pytest.raises(ValueError, match="lo < hi"):
            DefocusRange(3, 3)

    def test_exception_the_old_word_for_its_camera_warns(self):
        lens = ThinLensCamera(f_number=8)
        with pytest.warns(FutureWarning, match=r"DefocusRange\(lens=...\) is now DefocusRange\(camera=...\)"):
            old = DefocusRange(lens=lens)
        assert old.aperture_radius == DefocusRange(camera=lens).aperture_radius
        with pytest.raises(ValueError, match="takes camera= or its old word lens=, not both"):
            DefocusRange(camera=lens, lens=lens)

    def test_feature_resized_scales_the_pixel(self):
        assert DefocusRange().resized(2.0).pixel_pitch == 4e-6


class TestSinglet(BaseTester):
    def test_feature_axial_colour_is_the_focal_length_over_abbe_number(self):
        """Between the lines F and C the focal length of a singlet changes by f / V, V = 67.8 for fused silica."""
        lens = ThinLensCamera(lens_material=FUSED_SILICA)
        scale = math.pi * lens.aperture_radius**2 / 530e-9
        lines = (486.13e-9, 587.56e-9, 656.27e-9)
        blue, yellow, red = (1 / (1 / 50e-3 - lens.chromatic_defocus(line) / scale) for line in lines)
        assert red - blue == pytest.approx(yellow / 67.8, rel=0.01)

    @pytest.mark.parametrize("wavelength", [450e-9, 530e-9, 650e-9])
    def test_feature_the_psf_is_sharpest_where_the_lensmaker_says(self, wavelength):
        """The depth of the highest PSF peak, against 1/z = 1/f(lambda) - 1/s': the shift in defocus to 1 %."""
        camera = ThinLensCamera(lens_material=PMMA)
        fidelity = Fidelity(window=15, stray_light="discard", double=True)
        masks = PixelwiseMask(1, initial="flat")
        lens = PSFModel(masks, camera, fidelity=fidelity, spectrum=Spectrum.monochrome(wavelength))
        nodes = [-8 + 0.5 * i for i in range(33)]
        with torch.no_grad():
            peak = lens.psf_bank(defocus=nodes).psfs[:, 0, 7, 7]
        best = int(peak.argmax())
        left, top, right = peak[best - 1 : best + 2].tolist()
        found = nodes[best] + 0.5 * (left - right) / (left - 2 * top + right) / 2
        focal_length = 50e-3 * (PMMA.index(530e-9) - 1) / (PMMA.index(wavelength) - 1)
        inverse_depth = 1 / focal_length - 1 / camera.image_distance
        expected = math.pi * camera.aperture_radius**2 / 530e-9 * (inverse_depth - 1 / 0.595)
        assert found == pytest.approx(expected, rel=0.01, abs=1e-3)

    def test_feature_a_corrected_lens_has_no_axial_colour(self):
        assert ThinLensCamera().chromatic_defocus(470e-9) == 0
        assert DefocusRange().chromatic_defocus(470e-9) == 0

    def test_feature_travels_with_the_camera(self):
        lens = ThinLensCamera.for_scene((0.5, 4.0), lens_material=PMMA)
        assert DefocusRange(camera=lens).resized(0.5).chromatic_defocus(470e-9) == lens.chromatic_defocus(470e-9) < 0
        assert "a single element of PMMA" in repr(lens)

    @pytest.mark.parametrize("fidelity", ["draft", "paper"])
    def test_feature_swapping_the_lens_is_seen_at_once(self, fidelity):
        """The PSF cache depends on the lens material: with PMMA, red is sharp at its own focus and blue is not."""
        camera = DefocusRange(-10, 10)
        optics = PSFModel(PixelwiseMask(1, initial="flat"), camera, fidelity=fidelity)
        with torch.no_grad():
            corrected = optics.psf_bank(defocus=[-1.8]).psfs[0].amax((1, 2))
            camera.lens.lens_material = PMMA
            singlet = optics.psf_bank(defocus=[-1.8]).psfs[0].amax((1, 2))
        self.assert_close(singlet[1], corrected[1])
        assert singlet[0] > corrected[0]
        assert singlet[2] < corrected[2]
