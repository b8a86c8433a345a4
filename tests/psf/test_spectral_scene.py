"""Reflectance spectra: what must stay as it was, and what a scene of single wavelengths shows."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from kornia_tidy import Fidelity, PixelwiseMask, Spectrum, TiDyOptics
from kornia_tidy.optics import camera_spectrum
from kornia_tidy.optics.spectrum import smoothest_reflectances
from tests.base import BaseTester

SMALL = Fidelity(window=9, layer_spacing=8.0)


@pytest.fixture(scope="module")
def spectrum() -> Spectrum:
    return camera_spectrum(samples=7, reflectance=True)


def camera(spectrum: Spectrum, **changes) -> TiDyOptics:
    masks = PixelwiseMask(2, generator=torch.Generator().manual_seed(3))
    return TiDyOptics(masks, sensor=None, spectrum=spectrum, color_space="linear", fidelity=SMALL.replace(**changes))


@pytest.fixture
def scene() -> tuple[torch.Tensor, torch.Tensor]:
    depth = torch.linspace(0.3, 3.0, 24 * 20, dtype=torch.float64).reshape(1, 1, 24, 20)
    return torch.rand(1, 3, 24, 20, dtype=torch.float64), depth


class TestSmoothestReflectances(BaseTester):
    @pytest.mark.parametrize("samples", [3, 7, 31])
    @pytest.mark.parametrize("illuminant", ["D65", "A", "FL2"])
    def test_feature_colours_come_back_and_grey_is_flat(self, samples, illuminant):
        spectrum = camera_spectrum("Sigma SDMerill (NPL)", illuminant, samples, reflectance=True)
        basis, weights = np.array(spectrum.basis), np.array(spectrum.channel_weights)
        assert np.abs(weights @ basis.T - np.eye(3)).max() < 1e-9
        assert np.abs(basis.sum(0) - 1).max() < 1e-9

    def test_feature_no_other_reflectance_of_the_colour_is_smoother(self):
        """Against SciPy's null space of what the camera sees: all reflectances of one colour, searched for the best."""
        linalg = pytest.importorskip("scipy.linalg")
        weights = np.array(camera_spectrum(samples=9).channel_weights)
        colour = np.array([0.7, 0.2, 0.4])
        some, unseen = np.linalg.pinv(weights) @ colour, linalg.null_space(weights)
        change = linalg.lstsq(np.diff(unseen, axis=0), -np.diff(some))[0]
        assert np.abs(colour @ smoothest_reflectances(weights) - (some + unseen @ change)).max() < 1e-9

    def test_exception_fewer_wavelengths_than_channels(self):
        with pytest.raises(ValueError, match="samples must be at least 3 for reflectances of 3 channels, got 2"):
            camera_spectrum(samples=2, reflectance=True)

    @pytest.mark.parametrize(
        ("basis", "message"),
        [
            (((1.0, 0.0),), r"basis must have shape \(2, 2\) as the weights have, got \(1, 2\)"),
            (((1.0, 0.0), (1.0, 0.0)), "basis must give 1 in its own channel and 0 in the others"),
        ],
    )
    def test_exception_basis(self, basis, message):
        with pytest.raises(ValueError, match=message):
            Spectrum((500e-9, 600e-9), ((1, 0), (0, 1)), basis)


class TestSpectralScene(BaseTester):
    @pytest.mark.parametrize("stray_light", ["renormalize", "veil", "discard"])
    @pytest.mark.parametrize("layers", ["nearest", "linear", "cubic"])
    def test_feature_a_grey_scene_is_as_without_a_basis(self, spectrum, scene, stray_light, layers):
        grey, depth = scene[0][:, :1].expand(-1, 3, -1, -1), scene[1]
        options = {"stray_light": stray_light, "layers": layers}
        self.assert_close(
            camera(spectrum, **options)(grey, depth),
            camera(spectrum.flat(), **options)(grey, depth),
            rtol=0,
            atol=1e-12,
        )

    @pytest.mark.parametrize("stray_light", ["renormalize", "veil"])
    @pytest.mark.parametrize("colour", [(1.0, 1.0, 1.0), (0.9, 0.1, 0.4)], ids=["white", "red"])
    def test_feature_even_colours_stay_themselves(self, colour, spectrum, scene, stray_light):
        even = torch.tensor(colour, dtype=torch.float64)[:, None, None].expand_as(scene[0])
        depth = torch.full_like(scene[1], 0.4) if stray_light == "veil" else scene[1]  # a veil is of one depth
        self.assert_close(camera(spectrum, stray_light=stray_light)(even, depth), even, rtol=0, atol=1e-12)

    def test_feature_equals_wavelength_by_wavelength(self, spectrum, scene):
        """The scene as one image for each wavelength, each blurred alone, and seen by the sensor."""
        image, depth = scene
        weights, basis = (
            torch.tensor(rows, dtype=torch.float64) for rows in (spectrum.channel_weights, spectrum.basis)
        )
        seen = torch.zeros_like(image)
        for w, wavelength in enumerate(spectrum.wavelengths):
            light = torch.einsum("b,nbyx->nyx", basis[:, w], image)[:, None].expand(-1, 3, -1, -1)
            alone = camera(Spectrum((wavelength,), ((1,),) * 3), stray_light="discard")(light, depth)
            seen += weights[:, w, None, None] * alone
        self.assert_close(camera(spectrum, stray_light="discard")(image, depth), seen, rtol=0, atol=1e-12)

    def test_feature_the_bank_given_out_is_that_of_white_light(self, spectrum):
        self.assert_close(camera(spectrum).psf_bank().psfs, camera(spectrum.flat()).psf_bank().psfs)
        assert camera(spectrum).window == camera(spectrum.flat()).window

    def test_feature_one_channel_is_taken_as_ever(self, spectrum, scene):
        image = scene[0][:, :1]
        assert torch.equal(camera(spectrum)(image, scene[1]), camera(spectrum.flat())(image, scene[1]))

    def test_gradcheck_masks_and_image(self, spectrum, scene):
        optics = camera(spectrum, layer_spacing=40.0, window=5)
        image, depth = scene[0][..., :6, :6], scene[1][..., :6, :6]

        def capture(phase, picture):
            return torch.func.functional_call(optics.double(), {"masks.phase": phase}, (picture, depth))

        self.gradcheck(capture, (optics.masks.phase.detach(), image))
