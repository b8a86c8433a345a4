from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.interpolate import CubicHermiteSpline

from kornia_tidy import DefocusRange, Fidelity, PixelwiseMask, PSFBank, TiDyOptics
from kornia_tidy.psf.defocus_interpolation import (
    defocus_band,
    fine_layer_matrix,
    fine_nodes,
    interpolable_spacing,
    interpolated_bank,
    interpolation_matrix,
)
from tests.base import BaseTester

BAND = defocus_band(1.0, 470e-9, 530e-9)


class TestInterpolationMatrix(BaseTester):
    @pytest.mark.parametrize("band", [None, BAND])
    def test_property_white_stays_white_and_samples_stay_themselves(self, band):
        targets = tuple(np.random.default_rng(0).uniform(10, 30, 50).tolist())
        weights = np.array(interpolation_matrix(0.0, 2.0, 21, targets, band))
        assert np.abs(weights.sum(1) - 1).max() < 1e-12
        on_node = np.array(interpolation_matrix(0.0, 2.0, 21, (14.0, 20.0), band))
        assert np.abs(on_node - np.eye(21)[[7, 10]]).max() < 2e-3

    def test_feature_cubic_is_the_hermite_spline_with_central_slopes(self):
        samples = np.random.default_rng(1).normal(size=12)
        spline = CubicHermiteSpline(np.arange(12), samples, np.gradient(samples))
        targets = np.random.default_rng(2).uniform(1, 10, 30)
        got = np.array(interpolation_matrix(0.0, 1.0, 12, tuple(targets.tolist()), None)) @ samples
        assert np.abs(got - spline(targets)).max() < 1e-12

    def test_feature_waves_within_the_band_are_met(self):
        nodes, targets = np.arange(-30, 31, 2.0), np.random.default_rng(3).uniform(-15, 15, 40)
        weights = np.array(interpolation_matrix(-30.0, 2.0, 31, tuple(targets.tolist()), BAND))
        for share in (0.1, 0.5, 0.9):
            error = weights @ np.exp(1j * share * BAND * nodes) - np.exp(1j * share * BAND * targets)
            assert np.abs(error).max() < 5e-3
        beyond = weights @ np.exp(2.5j * BAND * nodes) - np.exp(2.5j * BAND * targets)
        assert np.abs(beyond).max() > 0.5

    @pytest.mark.parametrize("side", [1, 2, 3])
    def test_feature_masks_of_few_pixels_get_more_layers(self, side):
        """The corners of a pixel are far from its centre: by centres, captures were off by up to 1e-2."""
        masks = PixelwiseMask(2, side, generator=torch.Generator().manual_seed(0))
        camera = DefocusRange(-8.0, 8.0)
        noise = torch.Generator().manual_seed(1)
        image = torch.rand(1, 3, 48, 48, generator=noise, dtype=torch.float64)
        disparity = torch.linspace(0, 1, 48 * 48, dtype=torch.float64).view(1, 1, 48, 48)
        captures = [
            TiDyOptics(
                masks, camera, fidelity=Fidelity(window=41, layers="bandlimited", layer_spacing=spacing), sensor=None
            ).double()(image, disparity)
            for spacing in (1.0, 0.125)
        ]
        assert (captures[0] - captures[1]).abs().max() < 3e-3

    def test_gradcheck_reaches_the_bank(self):
        nodes = tuple(float(i) for i in range(12))

        def energies(psfs):
            bank = PSFBank(psfs, torch.tensor(nodes, dtype=psfs.dtype), psfs.sum((2, 3)))
            return interpolated_bank(bank, nodes, (14 / 3, 5.0), BAND).psfs

        self.gradcheck(energies, (torch.rand(12, 1, 3, 3),))

    @torch.no_grad()
    @pytest.mark.parametrize("layers", ["cubic", "bandlimited"])
    def test_feature_interpolated_psfs_are_not_negative_so_occlusion_mixes_what_is_there(self, layers):
        """Occlusion divides by the part of a PSF that sees a layer, which may be near zero where PSFs are negative."""
        generator = torch.Generator().manual_seed(0)
        image = 0.25 + 0.5 * torch.rand(1, 3, 22, 48, generator=generator)
        depth = 1 / (3.3 * torch.rand(1, 1, 22, 48, generator=generator) + 1e-3)
        fidelity = Fidelity(window=15, layers=layers, layer_spacing=5.0 if layers == "cubic" else 0.9)
        optics = TiDyOptics(
            PixelwiseMask(2, generator=generator), fidelity=fidelity, compositing="occlusion", sensor=None
        )
        optics.color_space = "linear"
        assert optics.psf_bank().psfs.min() >= 0
        coded = optics(image, depth)
        assert coded.min() > 0.25 - 1e-5
        assert coded.max() < 0.75 + 1e-5


class TestFineLayerMatrix(BaseTester):
    @pytest.mark.parametrize("spacing", [1.0, 0.9, 0.5])
    def test_property_lines_between_layers_meet_waves_to_a_sixteenth_of_the_bend(self, spacing):
        """Lines through points of the wave itself are off by an eighth of its bend times their length^2."""
        samples, wave = -10 + spacing * np.arange(60), lambda x: np.exp(0.9j * BAND * x)
        layers = np.array([x for x in fine_nodes(samples.tolist()) if -5 < x < 20])
        weights = np.array(fine_layer_matrix(-10.0, spacing, 60, tuple(layers.tolist()), BAND))
        psi = np.random.default_rng(5).uniform(-4, 19, 400)
        found = np.interp(psi, layers, weights @ wave(samples))
        bend = (0.9 * BAND * (layers[1] - layers[0])) ** 2
        error = np.abs(found - wave(psi))
        assert 0.9 * bend / 16 < error.max() < 1.1 * bend / 16
        assert np.sqrt((error**2).mean()) < 0.05 * bend


class TestContinuousDepth(BaseTester):
    """L1 error of the PSF a pixel gets, for a random mask, against the PSF computed for its own depth."""

    LIMITS = (  # layers, spacing, mean, worst
        ("nearest", 2.0, 0.13, 0.22),
        ("linear", 2.0, 0.05, 0.08),
        ("cubic", 2.0, 0.02, 0.035),
        ("cubic", 1.0, 2e-3, 4e-3),
        ("bandlimited", 2.0, 2e-3, 3.5e-3),
        ("bandlimited", 1.0, 7e-4, 1.3e-3),
    )

    @pytest.mark.parametrize(("layers", "spacing", "mean", "worst"), LIMITS)
    @torch.no_grad()
    def test_feature_psf_error_of_each_kind_of_layers(self, layers, spacing, mean, worst):
        torch.manual_seed(1)
        masks = PixelwiseMask(2)
        fidelity = Fidelity(layers=layers, layer_spacing=spacing, window=31, stray_light="discard")
        optics = TiDyOptics(masks, sensor=None, color_space="linear", fidelity=fidelity)
        point = torch.zeros(1, 3, 61, 61)
        point[..., 30, 30] = 1
        errors = []
        for psi in np.random.default_rng(4).uniform(-20, 20, 20):
            depth = 1 / (psi * 530e-9 / (np.pi * optics.camera.aperture_radius**2) + 1 / 0.595)
            got = optics(point, torch.full((1, 1, 61, 61), depth))[..., 15:46, 15:46]
            expected = optics.psf_bank(defocus=(float(psi),)).psfs
            errors.append((got - expected).abs().sum((2, 3)) / expected.sum((2, 3)))
        assert float(torch.stack(errors).mean()) < mean
        assert float(torch.stack(errors).max()) < worst

    def test_feature_samples_stand_as_close_as_the_band_asks_for(self):
        optics = TiDyOptics(fidelity=Fidelity(layers="bandlimited", layer_spacing=3.0, window=5))
        nodes = np.array(optics.defocus_nodes)
        assert np.diff(nodes).max() < 1.05 * interpolable_spacing(defocus_band(1.145, 470e-9, 530e-9))
        reference = Fidelity.preset("reference").replace(window=5)
        square = TiDyOptics(PixelwiseMask(1), fidelity=reference, aperture=torch.ones(23, 23))
        assert np.diff(square.defocus_nodes).max() < 0.6 * np.diff(nodes).max()
