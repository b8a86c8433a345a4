from __future__ import annotations

import pytest
import scipy.ndimage
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from kornia_tidy import Fidelity, PixelwiseMask, TiDyOptics
from kornia_tidy.accuracy import Planner
from kornia_tidy.accuracy.depth_energy import Depths, octave_filters
from kornia_tidy.accuracy.error_model import change_error, layer_coefficients
from kornia_tidy.accuracy.scene_light import CONTRAST, SceneLight, natural_power, power_spectrum
from kornia_tidy.render import render
from tests.base import BaseTester

FLAT = Depths(torch.zeros(1, 1, 4, 4), -20, 20, "reflect")


def one_depth(power: torch.Tensor) -> SceneLight:
    """Light of a power spectrum, all at one depth."""
    octaves = (power[:, None] * octave_filters(power.shape[-2])).sum((-2, -1))
    return SceneLight(power, FLAT.psi, octaves[..., None])


class TestPower(BaseTester):
    @settings(max_examples=20)
    @given(st.integers(9, 24), st.integers(9, 24), st.sampled_from([1, 3, 5]), st.integers(0, 1000))
    def test_property_power_times_filter_is_the_mean_square(self, height, width, side, seed):
        generator = torch.Generator().manual_seed(seed)
        light = torch.rand(2, 1, height, width, dtype=torch.float64, generator=generator)
        kernel = torch.randn(side, side, dtype=torch.float64, generator=generator)
        kernel -= kernel.mean()
        blurred = [scipy.ndimage.convolve(plane[0].numpy(), kernel.numpy(), mode="wrap") for plane in light]
        expected = sum((plane**2).mean() for plane in blurred) / 2
        size = 2 * side + 1  # no shift of the kernel against itself reaches round
        response = torch.fft.rfft2(kernel, s=(size, size)).abs().square()
        self.assert_close(
            (power_spectrum(light, "circular", size) * response).sum(), torch.tensor(expected), atol=1e-12
        )

    @pytest.mark.parametrize("border", ["reflect", "replicate", "zero"])
    def test_feature_borders_are_accounted_for(self, border):
        """A small image and a wide blur, where half of the light is made up."""
        generator = torch.Generator().manual_seed(0)
        light = torch.rand(1, 1, 30, 30, dtype=torch.float64, generator=generator)
        kernel = torch.ones(15, 15, dtype=torch.float64) / 225
        kernel[7, 7] -= 1
        mode = {"reflect": "mirror", "replicate": "nearest", "zero": "constant"}[border]
        measured = (scipy.ndimage.convolve(light[0, 0].numpy(), kernel.numpy(), mode=mode) ** 2).mean()
        response = torch.fft.rfft2(kernel, s=(31, 31)).abs().square()
        assert 0.9 < float((power_spectrum(light, border, 31) * response).sum()) / measured < 1.6

    def test_feature_a_veil_is_dark_where_it_comes_from_beyond_a_zero_border(self):
        dark = 1 - scipy.ndimage.uniform_filter(torch.ones(30, 30).double().numpy(), 15, mode="constant")
        power = power_spectrum(torch.ones(1, 1, 30, 30), "zero", 31)
        assert float(power[0, 0, 0]) == pytest.approx((dark**2).mean())

    def test_feature_large_images_are_read_in_blocks(self, monkeypatch):
        light = torch.rand(1, 1, 64, 48, dtype=torch.float64)
        whole = power_spectrum(light, "reflect", 7)
        monkeypatch.setattr("kornia_tidy.accuracy.scene_light._BLOCK", 32)
        self.assert_close(power_spectrum(light, "reflect", 7).sum(), whole.sum(), rtol=0.05, atol=0)

    def test_feature_a_typical_photograph_has_its_contrast_and_slope(self):
        power = natural_power(2, 64)
        assert float(power[0].sum()) == pytest.approx(CONTRAST**2)
        assert float(power[1, 0, 4] / power[1, 0, 8]) == pytest.approx(4)

    @pytest.mark.parametrize("border", ["reflect", "circular"])
    def test_feature_a_veil_leaves_the_mean_and_takes_what_varies(self, border):
        """What a veil of a tenth changes in an image: a tenth of its deviation from its mean, however slow."""
        light = torch.linspace(0, 1, 60, dtype=torch.float64).expand(1, 1, 60, 60)
        light_there = one_depth(power_spectrum(light, border, 64))
        error = change_error((0.0,), -0.1 * torch.ones(1, 1, 1, 1), light_there)
        assert error == pytest.approx(0.1 * float(light.std(correction=0)), rel=0.05)

    def test_feature_the_error_grows_with_the_brightness(self):
        power = power_spectrum(torch.rand(1, 1, 60, 60, dtype=torch.float64), "reflect", 64)
        change = torch.zeros(1, 1, 3, 3, dtype=torch.float64)
        change[..., 1, :] = torch.tensor([0.1, -0.2, 0.1])
        dim, bright = (change_error((0.0,), change, one_depth(power * scale**2)) for scale in (1, 1000))
        assert bright == pytest.approx(1000 * dim)

    def test_feature_one_depth_is_the_image_and_two_have_outlines(self):
        """Of white light, which one depth leaves alone."""
        white = torch.ones(1, 1, 20, 20)
        for defocus, least, most in ((torch.zeros(1, 1, 20, 20), -1e-6, 1e-6), (torch.rand(1, 1, 20, 20), 0.1, 1)):
            depths = Depths(defocus, -20, 20, "circular")
            (energies,) = SceneLight.seen(white, depths, "circular", 15, "scatter").energies
            assert least < float(torch.einsum("cjbb->", energies)) < most


class TestLayers(BaseTester):
    @pytest.mark.parametrize("layers", ["nearest", "linear", "cubic", "bandlimited"])
    def test_feature_a_pixel_takes_what_the_camera_gives_it(self, layers):
        """Against the capture of a point, which is the layered PSF of the camera."""
        fidelity = Fidelity(window=15, layers=layers, layer_spacing=1.0, stray_light="discard", double=True)
        optics = TiDyOptics(PixelwiseMask(1), sensor=None, fidelity=fidelity, color_space="linear", border="zero")
        samples, psi = Planner(optics, 3), torch.tensor([-7.3], dtype=torch.float64)
        weights, at = layer_coefficients(psi, optics.defocus_nodes, layers, samples.band)
        point = torch.zeros(1, 3, 15, 15, dtype=torch.float64)
        point[..., 7, 7] = 1
        with torch.no_grad():
            psf = torch.einsum("an,ncpq->acpq", weights, optics.psf_bank(3, torch.float64, tuple(at)).psfs)
            bank = optics.psf_model.scene_bank(3, torch.float64, psi)
            mode = "nearest" if layers == "nearest" else "linear"
            coded = render(point, psi.expand(1, 1, 15, 15), bank, layers=mode, border="zero")
        self.assert_close(coded, psf, atol=1e-12, rtol=0)

    def test_feature_large_psfs_are_made_for_a_depth_at_a_time(self, monkeypatch):
        """And not remembered; they are the same."""
        optics, depths = TiDyOptics(PixelwiseMask(1), sensor=None), (-7.3, 0.2, 11.0)
        at_once = Planner(optics, 3).layered("cubic", 1.0, depths, 15)
        monkeypatch.setattr("kornia_tidy.accuracy.planning.planner._LARGEST_REMEMBERED", 13)
        self.assert_close(Planner(optics, 3).layered("cubic", 1.0, depths, 15), at_once, rtol=0, atol=1e-12)

    def test_feature_a_pixel_of_a_very_wide_range_takes_the_layers_around_it(self):
        """The weights of all its fine layers would be some gigabytes."""
        psi = torch.tensor([-7.3, 4321.0], dtype=torch.float64)
        weights, at = layer_coefficients(psi, tuple(map(float, range(-10_000, 10_001))), "bandlimited", 1.2)
        self.assert_close(weights @ torch.tensor(at, dtype=torch.float64), psi, rtol=0, atol=0.01)

    def test_feature_differences_are_those_of_convolved_images(self):
        generator = torch.Generator().manual_seed(0)
        light = torch.rand(1, 1, 24, 24, dtype=torch.float64, generator=generator)
        change = torch.randn(1, 1, 3, 3, generator=generator)
        varying = light[0, 0] - light.mean()
        expected = (scipy.ndimage.convolve(varying.numpy(), change[0, 0].numpy(), mode="wrap") ** 2).mean() ** 0.5
        error = change_error((0.0,), change, one_depth(power_spectrum(light, "circular", 64)))
        assert error == pytest.approx(expected, rel=0.05)  # a tenth of the shape is a photograph's

    def test_feature_changes_that_alternate_do_not_cancel_between_depths(self):
        """Of white light, whose outlines at two depths cancel each other unless its PSFs change differently."""
        white, defocus = torch.ones(1, 1, 32, 32), 0.3 * (torch.arange(32) % 2).expand(1, 1, 32, 32)
        light = SceneLight.seen(white, Depths(defocus, -20, 20, "circular"), "circular", 32, "scatter")
        changes = torch.zeros(2, 1, 3, 3)
        changes[..., 1, 1], changes[..., 0, 1] = 0.1, -0.1
        same, alternating = (change_error((0.0, 0.3), changes, light, alternate=each) for each in (False, True))
        assert same < 0.02
        assert 0.04 < alternating < 0.11

    def test_feature_depths_are_where_pixels_and_light_are(self):
        light, defocus = torch.zeros(1, 1, 40, 40), torch.linspace(-10, 10, 40).expand(1, 1, 40, 40)
        light[..., 20, 33] = 100.0
        depths = SceneLight.seen(light, Depths(defocus, -20, 20, "reflect"), "reflect", 64, "gather").depths(8)
        assert len(depths) == len(set(depths)) <= 8
        assert depths[0] == pytest.approx(-10)
        assert depths[-1] == pytest.approx(10)
        assert min(abs(psi - float(defocus[0, 0, 0, 33])) for psi in depths) < 0.1
