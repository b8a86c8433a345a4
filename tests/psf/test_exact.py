"""The library's PSFs against brute force, at the extremes of defocus, for random masks as well as flat ones."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from kornia_tidy import DefocusRange, Fidelity, PixelwiseMask, Spectrum, ThinLensCamera, TiDyOptics
from kornia_tidy.optics import FUSED_SILICA, circular_aperture
from kornia_tidy.psf import Pupil, exact_psf_bank
from kornia_tidy.psf.propagation import gauss_legendre_order
from tests.base import BaseTester
from tests.masks.registry import ONE_MASK
from tests.simulated_device import SimulatedDevice


def brute_force(height: np.ndarray, psi: float, wavelength: float, window: int, step: float, samples: int, sub: int):
    """Midpoint samples of the pupil and of the sensor's pixels; step is a pixel in cycles per pupil radius."""
    x = ((np.arange(23 * samples) + 0.5) / samples - 11.5) * 0.1
    centre = (np.arange(23) - 11) * 0.1
    open_ = (centre[:, None] ** 2 + centre**2 <= 1 + 1e-9) * 1.0
    field = open_ * np.exp(2j * np.pi / wavelength * 0.5 * height)
    lens = np.exp(1j * psi * 530e-9 / wavelength * x**2)
    u = (np.arange(window * sub) - (window * sub - 1) / 2) * step / sub
    kernel = (np.exp(-2j * np.pi * u[:, None] * x) * lens).reshape(len(u), 23, samples).sum(-1) * (0.1 / samples)
    intensity = np.abs(kernel @ field @ kernel.T) ** 2 * (step / sub) ** 2 / (open_.sum() * 0.01)
    return intensity.reshape(window, sub, window, sub).sum((1, 3))


def by_quadrature(phase: np.ndarray, psi: float, wavelength: float, window: int, step: float) -> np.ndarray:
    """The same by Gauss-Legendre quadrature, for an (N, N) phase at 530 nm of an index of 1.5 at all wavelengths."""
    pitch = 2.3 / len(phase)
    centre = (np.arange(len(phase)) - (len(phase) - 1) / 2) * pitch
    open_ = (centre[:, None] ** 2 + centre**2 <= 1 + 1e-9) * 1.0
    field = open_ * np.exp(1j * phase * 530e-9 / wavelength)
    nodes, weights = np.polynomial.legendre.leggauss(32)  # phases within a cell reach 13 rad from its middle: 1e-15
    x = centre[:, None] + nodes * pitch / 2
    points, shares = np.polynomial.legendre.leggauss(12)
    u = ((np.arange(window) - window // 2)[:, None] + points / 2).ravel() * step
    lens = np.exp(1j * psi * 530e-9 / wavelength * x**2) * (weights * pitch / 2)
    kernel = np.stack([np.exp(-2j * np.pi * u[:, None] * cell) @ own for cell, own in zip(x, lens, strict=True)], 1)
    share = np.tile(shares / 2, window) * step
    intensity = np.abs(kernel @ field @ kernel.T) ** 2 * (share[:, None] * share) / (open_.sum() * pitch**2)
    return intensity.reshape(window, 12, window, 12).sum((1, 3))


class TestPixelStep(BaseTester):
    @pytest.mark.parametrize("step", [0.4, torch.tensor(0.4), 1.1e-4, 0.0, -2e-7, float("nan"), float("inf"), 1e-16])
    def test_exception_other_units(self, step):
        """A step in cycles took days."""
        lens = Pupil(torch.ones(23, 23), 0.1), Spectrum.monochrome(), [1.0], [0.0]
        with pytest.raises(ValueError, match=rf"pixel_step must be .*metres.* got {float(step):.3}"):
            exact_psf_bank(torch.zeros(1, 23, 23), torch.ones(1), *lens, step, 5)


LIMITS = {"draft": 3e-2, "balanced": 1e-3, "reference": 1e-6}


class TestFamilies(BaseTester):
    @pytest.mark.parametrize(("wavelength", "psi"), [(400e-9, [-60.0, 0.0, 20.0]), (700e-9, [-20.0, 60.0])])
    @pytest.mark.parametrize("family", ONE_MASK)
    def test_feature_presets_keep_their_promise(self, family, wavelength, psi):
        """L1 error relative to the light in the window, at the default camera, in focus and far out of it."""
        phase = ONE_MASK[family](torch.Generator().manual_seed(3)).phase.detach().double()
        lens, cells = ThinLensCamera(), phase.shape[-1]
        step = lens.pixel_pitch * lens.aperture_radius / lens.image_distance
        pupil, one = Pupil(circular_aperture(cells, 2.3 / cells), 2.3 / cells), torch.ones(1, dtype=torch.float64)
        expected = np.stack([by_quadrature(phase[0].numpy(), p, wavelength, 41, step / wavelength) for p in psi])
        for name, limit in LIMITS.items():
            tolerance = Fidelity.preset(name).pixel_tolerance
            at = Spectrum.monochrome(wavelength), [530e-9 / wavelength], psi, step, 41, tolerance
            error = np.abs(exact_psf_bank(phase, one, pupil, *at).psfs[:, 0].numpy() - expected).sum((1, 2))
            assert float((error / expected.sum((1, 2))).max()) < limit, name

    @pytest.mark.parametrize("family", ["flat", "cubic", "strong Zernike"])
    @pytest.mark.parametrize(("points", "share"), [(1, 0.3), (2, 1 / 6), (3, 1 / 8), (4, 1 / 8), (6, 1 / 8)])
    def test_feature_pixel_tolerance_bounds_whole_psfs_for_pixels_of_any_size(self, family, points, share):
        """The largest pixels that so many points are taken for: there the integral is off by the tolerance."""
        phase = ONE_MASK[family](torch.Generator().manual_seed(3)).phase.detach().double()
        pupil, one = Pupil(circular_aperture(23), 0.1), torch.ones(1, dtype=torch.float64)
        for tolerance in (1e-1, 1e-2, 1e-3):
            sizes = np.linspace(0.05, 1.8, 200)
            orders = [gauss_legendre_order(2 * np.pi * pupil.extent * size, tolerance) for size in sizes]
            if points not in orders:
                continue
            step = float(sizes[np.flatnonzero(np.array(orders) == points)[-1]])
            expected = by_quadrature(phase[0].numpy(), 0.0, 530e-9, 61, step)
            at = Spectrum.monochrome(), [1.0], [0.0], step * 530e-9, 61, tolerance
            error = np.abs(exact_psf_bank(phase, one, pupil, *at).psfs[0, 0].numpy() - expected).sum()
            assert error / expected.sum() < share * tolerance
            if points >= 3 and tolerance == Fidelity.preset("balanced").pixel_tolerance:
                assert error / expected.sum() < LIMITS["balanced"]


@pytest.mark.filterwarnings("ignore:the largest PSF window")  # at psi = 60 the presets' windows are small
class TestExtremes(BaseTester):
    @pytest.mark.takes_seconds
    @pytest.mark.parametrize(("name", "limit"), [("draft", 3e-2), ("balanced", 1e-3), ("reference", 3e-4)])
    @pytest.mark.parametrize("kind", ["random", "flat"])
    def test_feature_presets_never_alias(self, kind, name, limit):
        """L1 error relative to the light in the window, in blue, where defocus is strongest."""
        height = np.random.default_rng(1).uniform(0, 1.2e-6, (23, 23)) * (kind == "random")
        camera = DefocusRange(-60, 60)
        fidelity = Fidelity.preset(name).replace(layers="linear", layer_spacing=20.0, stray_light="discard")
        optics = TiDyOptics(PixelwiseMask(initial=torch.from_numpy(height)), camera, fidelity=fidelity)
        with torch.no_grad():
            psfs = optics.psf_bank().psfs[:, 2].double().numpy()
        step = camera.pixel_pitch * camera.aperture_radius / camera.image_distance / 470e-9
        for psi in (0.0, 20.0, 60.0) if kind == "flat" else (0.0, -20.0, 60.0):
            fine, coarse = (brute_force(height, psi, 470e-9, optics.window, step, 120, sub) for sub in (12, 6))
            expected = fine + (fine - coarse) / 3  # Richardson: the midpoint rule's error goes as the square
            psf = psfs[optics.defocus_nodes.index(psi)]
            assert np.abs(psf - expected).sum() / expected.sum() < limit

    def test_feature_float32_stays_with_float64_at_a_thousand_radians(self):
        """Phases of thousands of radians are formed in float64, whatever the images are."""
        camera = DefocusRange(-1000, 1000)
        settings_ = Fidelity(layer_spacing=500.0, window=201, stray_light="discard")
        optics = TiDyOptics(camera=camera, fidelity=settings_)
        single, double = (optics.psf_bank(dtype=t).psfs.detach().double() for t in (torch.float32, torch.float64))
        error = (single - double).abs().sum((2, 3)) / double.sum((2, 3))
        assert float(error.max()) < 1e-4


class TestExactBank(BaseTester):
    @settings(max_examples=25)
    @given(
        f_number=st.floats(1.4, 64),
        psi=st.floats(-100, 100),
        pitch=st.floats(1e-6, 12e-6),
        seed=st.integers(0, 2**31),
        preset=st.sampled_from(["draft", "balanced"]),
    )
    def test_property_a_window_never_holds_more_than_all_the_light(self, f_number, psi, pitch, seed, preset):
        lens = ThinLensCamera(50e-3, 50e-3 / f_number, 2.0, pitch)
        masks = PixelwiseMask(1, generator=torch.Generator().manual_seed(seed))
        tolerance = Fidelity.preset(preset).pixel_tolerance
        step = lens.pixel_pitch * lens.aperture_radius / lens.image_distance
        pupil = Pupil(circular_aperture(23), 0.1)
        phase, one = masks.phase.detach().double(), torch.ones(1)
        bank = exact_psf_bank(phase, one, pupil, Spectrum.rgb(), [530 / 610, 1, 530 / 470], [psi], step, 21, tolerance)
        assert bool((bank.energy > 0).all())
        assert float(bank.energy.max()) <= 1
        assert float(bank.psfs.min()) >= 0

    def test_feature_channels_average_their_wavelengths(self):
        wavelengths = (500e-9, 600e-9)
        mixed = Spectrum(wavelengths, ((1.0, 3.0),))
        phase = torch.rand(1, 23, 23, dtype=torch.float64) * 7
        pupil, one = Pupil(circular_aperture(23), 0.1), torch.ones(1)
        material = PixelwiseMask(material=FUSED_SILICA)
        dispersion = [material.dispersion(w) for w in wavelengths]
        bank = exact_psf_bank(phase, one, pupil, mixed, dispersion, [3.0], 2e-7, 15)
        alone = [
            exact_psf_bank(phase, one, pupil, Spectrum.monochrome(w), [n], [3.0], 2e-7, 15).psfs
            for w, n in zip(wavelengths, dispersion, strict=True)
        ]
        self.assert_close(bank.psfs, 0.25 * alone[0] + 0.75 * alone[1], rtol=1e-9, atol=1e-12)

    def test_feature_kernels_made_in_inference_mode_serve_training_later(self):
        camera = ThinLensCamera(pixel_pitch=7.7e-6)
        settings_ = Fidelity(window=9, layer_spacing=20.0)
        with torch.inference_mode():
            TiDyOptics(PixelwiseMask(1), camera, fidelity=settings_).psf_bank()
        optics = TiDyOptics(PixelwiseMask(1), camera, fidelity=settings_)
        optics.psf_bank().psfs.square().sum().backward()
        assert float(optics.masks.phase.grad.abs().max()) > 0

    def test_feature_matrices_remembered_on_an_accelerator_are_those_of_the_lens(self):
        masks = torch.rand(2, 7, 7, generator=torch.Generator().manual_seed(3)), torch.tensor([0.4, 0.6])
        for step, pitch in ((2e-7, 0.3), (3e-7, 0.3), (3e-7, 0.25)):
            lens = Pupil(torch.ones(7, 7), pitch), Spectrum.monochrome(), [1.0], [3.0], step, 9
            with SimulatedDevice() as device:
                found = exact_psf_bank(*map(device.put, masks), *lens).psfs.on_cpu
            self.assert_close(found, exact_psf_bank(*masks, *lens).psfs, rtol=0, atol=1e-6)

    def test_gradcheck_masks_weights_and_pixel_step(self):
        pupil = Pupil(circular_aperture(23), 0.1)
        self.gradcheck(
            lambda p, w, s: exact_psf_bank(p, w, pupil, Spectrum.monochrome(), [1.0], [5.0, -8.0], s * 1e-7, 5).psfs,
            (torch.rand(2, 23, 23), torch.tensor([0.4, 0.6]), torch.tensor(2.0)),
        )
