from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from kornia_tidy import DwellTimes, Fidelity, LearnableDwellTimes, PixelwiseMask, SpatialLightModulator
from kornia_tidy.design import crlb
from kornia_tidy.design.fisher_information import PointResponse, defocus_bound, defocus_response, fisher_information
from kornia_tidy.masks import CubicMask, PhaseMasks, ZernikeMask
from kornia_tidy.optics import PMMA, DefocusRange, Spectrum, ThinLensCamera, circular_aperture
from kornia_tidy.psf import PSFModel
from tests.base import BaseTester, shared
from tests.design.published_setting import sampled_response

APERTURE = circular_aperture(23)
FINE = Fidelity("fine", pixel_tolerance=1e-4, window=25, stray_light="discard", double=True)


def smooth_mask(seed: int = 3, rms: float = 1.0) -> Tensor:
    """Return a smooth mask without symmetry, (1, 23, 23) radians."""
    strengths = rms / 28**0.5 * torch.randn(28, generator=torch.Generator().manual_seed(seed))
    return ZernikeMask(1, num_modes=28, initial=strengths).phase.detach().double()


class GivenPhase(PhaseMasks):
    """Masks with a given phase tensor, so that gradients pass to it."""

    def __init__(self, phase: Tensor) -> None:
        super().__init__()
        self.register_buffer("phase", phase)


class SampledCamera:
    """The published setting with NumPy's FFT: expected photons of a point and their derivatives."""

    def __init__(self, phase: np.ndarray, photons: float, background: float, samples: int = 64) -> None:
        self.index = np.arange(23) - 11.0
        rho2 = (self.index[:, None] ** 2 + self.index**2) / 100
        self.rho2 = np.where(rho2 <= 1 + 1e-9, rho2, 0)
        self.field = np.where(rho2 <= 1 + 1e-9, np.exp(1j * phase), 0) / 317**0.5
        self.photons, self.background, self.samples = photons, background, samples

    def expected(self, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return photons (T, M²) and derivatives (T, 3, M²) at T points (psi, x, y), with x and y in pixels."""
        psi, x, y = parameters.T[..., None, None]
        column = 2 * np.pi / self.samples * self.index
        row = column[:, None]
        wave = self.field * np.exp(1j * (psi * self.rho2 + x * column + y * row))
        waves = np.stack([wave, 1j * self.rho2 * wave, 1j * column * wave, 1j * row * wave])
        light = np.fft.fft2(waves, s=(self.samples, self.samples)) / self.samples
        counts = self.photons * np.abs(light[0]) ** 2 + self.background
        derivatives = 2 * self.photons * (light[0].conj() * light[1:]).real
        return counts.reshape(len(psi), -1), derivatives.transpose(1, 0, 2, 3).reshape(len(psi), 3, -1)

    def bound(self, psi: float) -> float:
        counts, derivatives = self.expected(np.array([[psi, 0, 0]]))
        return float(np.linalg.inv((derivatives[0] / counts[0]) @ derivatives[0].T)[0, 0] ** 0.5)

    def most_likely(self, images: np.ndarray, start: np.ndarray, steps: int) -> np.ndarray:
        """Return maximum likelihood estimates by Fisher scoring from the true values, to find the maximum near them."""
        found = np.tile(start, (len(images), 1))
        for _ in range(steps):
            counts, derivatives = self.expected(found)
            score = np.einsum("tip,tp->ti", derivatives, images / counts - 1)
            information = np.einsum("tip,tjp->tij", derivatives / counts[:, None], derivatives)
            step = np.linalg.solve(information, score[..., None])[..., 0]
            found = found + np.clip(step, -1, 1)
        return found


def errors_of_maximum_likelihood(camera: SampledCamera, psi: float, trials: int, steps: int) -> np.ndarray:
    generator, truth = np.random.default_rng(int(psi) + 100), np.array([psi, 0.0, 0.0])
    counts, _ = camera.expected(truth[None])
    batches = [generator.poisson(counts[0], (100, counts.shape[1])) for _ in range(trials // 100)]
    return np.concatenate([camera.most_likely(images, truth, steps) for images in batches])[:, 0] - psi


class TestBoundIsReached(BaseTester):
    @pytest.mark.takes_seconds
    @pytest.mark.parametrize("psi", [-8.0, 0.0, 8.0])
    def test_feature_maximum_likelihood_scatters_by_the_bound(self, psi):
        """With 1000 images of 3000 photons, the standard deviation is measured to 2 %."""
        camera = SampledCamera(smooth_mask()[0].numpy(), 3000, 5)
        errors = errors_of_maximum_likelihood(camera, psi, 1000, steps=3)
        bound = float(defocus_bound(fisher_information(sampled_response(smooth_mask(), APERTURE, [psi]))))
        assert errors.std() == pytest.approx(bound, rel=0.1)
        assert abs(errors.mean()) < bound / 5  # small enough for the bound on unbiased estimates to apply


class TestSampledResponse(BaseTester):
    def test_feature_averages_masks_by_their_weights(self):
        pair = torch.cat([smooth_mask(1), smooth_mask(2)])
        mean = sampled_response(pair, APERTURE, [4.0], weights=torch.tensor([0.75, 0.25]))
        first, second = (sampled_response(mask[None], APERTURE, [4.0]) for mask in pair)
        self.assert_close(mean.psfs, 0.75 * first.psfs + 0.25 * second.psfs)
        self.assert_close(mean.derivatives, 0.75 * first.derivatives + 0.25 * second.derivatives)
        equal = sampled_response(pair, APERTURE, [4.0])
        self.assert_close(equal.psfs, (first.psfs + second.psfs) / 2)

    @pytest.mark.parametrize(("limit", "published"), [(10, 0.0785), (20, 0.0958)])
    def test_feature_the_published_mask_has_its_published_bound(self, limit, published):
        heights = torch.from_numpy(np.loadtxt(shared("data/masks/PhaseCam3D/FisherMask_HeightMap.txt")))
        response = sampled_response(heights[None] * (math.pi / 530e-9), APERTURE, np.linspace(-limit, limit, 21))
        assert float(defocus_bound(fisher_information(response)).mean()) == pytest.approx(published, abs=5e-5)


LENSES = {
    "pixelwise": lambda: (PixelwiseMask(1), {}),
    "two masks": lambda: (PixelwiseMask(2), {"modulator": LearnableDwellTimes((3, 1))}),
    "wide": lambda: (PixelwiseMask(1, size=(23, 31)), {}),
    "gaps": lambda: (PixelwiseMask(1), {"modulator": SpatialLightModulator(DwellTimes(), fill_factor=0.9)}),
    "mixed channels": lambda: (PixelwiseMask(1), {"spectrum": Spectrum((5e-7, 6e-7), ((1, 1), (0, 1)))}),
    "glass": lambda: (PixelwiseMask(1), {"camera": DefocusRange(camera=ThinLensCamera(lens_material=PMMA))}),
}


class TestDefocusResponse(BaseTester):
    @pytest.mark.parametrize("case", LENSES)
    def test_feature_is_the_bank_and_its_derivative(self, case):
        """Against the PSF bank and its central differences over defocus, which are exact to second order."""
        masks, parts = LENSES[case]()
        lens = PSFModel(masks, fidelity=FINE, **parts)
        nodes, h = [-17.0, 0.0, 3.0], 1e-4
        psfs, derivatives = defocus_response(lens, nodes)
        with torch.no_grad():
            bank, above, below = (lens.psf_bank(defocus=[psi + d for psi in nodes]).psfs for d in (0, h, -h))
        self.assert_close(psfs, bank, rtol=0, atol=1e-9)
        self.assert_close(derivatives[0], (above - below) / (2 * h), rtol=0, atol=1e-8)
        assert derivatives[0].abs().max() > 1e-3

    @pytest.mark.parametrize("axis", [1, 2])
    def test_feature_derivatives_of_position_are_those_of_a_tilted_wave(self, axis):
        """A tilt on fine mask pixels shifts the PSF; `pixel` cycles per pupil radius shift it by one sensor pixel."""
        lens = PSFModel(PixelwiseMask(1, size=115, initial="flat"), fidelity=FINE, spectrum=Spectrum.monochrome())
        camera, h = lens.camera, 1e-3
        pixel = camera.pixel_pitch * camera.aperture_radius / camera.image_distance / 530e-9
        x = (torch.arange(115, dtype=torch.float64) - 57) * 0.02
        tilt = 2 * math.pi * pixel * h * (x if axis == 1 else x[:, None]).expand(115, 115)
        moved = [
            PSFModel(
                PixelwiseMask(initial=sign * tilt * (530e-9 / math.pi)).double(),
                fidelity=FINE,
                spectrum=Spectrum.monochrome(),
            )
            for sign in (1, -1)
        ]
        with torch.no_grad():
            psfs = [one.psf_bank(defocus=[6.0]).psfs for one in moved]
        derivatives = defocus_response(lens, [6.0]).derivatives[axis]
        self.assert_close(
            derivatives, (psfs[0] - psfs[1]) / (2 * h), rtol=0, atol=3e-4 * float(derivatives.detach().abs().max())
        )

    def test_feature_a_learnable_focus_and_default_nodes(self):
        lens = PSFModel(PixelwiseMask(1), ThinLensCamera(focus_distance=torch.tensor(0.595)), fidelity="draft")
        psfs, derivatives = defocus_response(lens)
        assert psfs.shape == (len(lens.defocus_nodes), 3, lens.window, lens.window)
        assert derivatives.shape == (3, *psfs.shape)
        assert psfs.dtype == derivatives.dtype == torch.float64


class TestFisherInformation(BaseTester):
    def test_feature_a_point_between_two_pixels(self):
        """Two pixels share N photons as p to 1 - p: the information is that of a binomial, N p'²/(p(1-p))."""
        psfs = torch.tensor([0.2, 0.8]).double().reshape(1, 1, 1, 2)
        derivatives = torch.tensor([0.3, -0.3]).double().expand(3, 1, 1, 1, 2)
        information = fisher_information(PointResponse(psfs, derivatives), photons=50, background=0)
        self.assert_close(information, torch.full((1, 3, 3), 50 * 0.09 / 0.16).double())

    def test_feature_channels_add_up(self):
        lens = PSFModel(PixelwiseMask(1), fidelity="draft")
        both = defocus_response(lens, [5.0])
        parts = [PointResponse(both.psfs[:, [c]], both.derivatives[:, :, [c]]) for c in range(3)]
        self.assert_close(fisher_information(both), sum(fisher_information(part) for part in parts))

    @pytest.mark.parametrize("photons", [0, -1, math.inf, math.nan])
    def test_exception_photons(self, photons):
        with pytest.raises(ValueError, match="photons must be positive"):
            fisher_information(sampled_response(smooth_mask(), APERTURE, [0.0]), photons)

    @pytest.mark.parametrize("background", [-1, math.inf, math.nan])
    def test_exception_background(self, background):
        with pytest.raises(ValueError, match="background must be finite and not negative, got"):
            fisher_information(sampled_response(smooth_mask(), APERTURE, [0.0]), background=background)


class TestDefocusBound(BaseTester):
    def test_feature_is_the_corner_of_the_inverse(self):
        root = torch.randn(4, 3, 3, dtype=torch.float64)
        information = root @ root.mT + torch.eye(3)
        self.assert_close(defocus_bound(information), torch.linalg.inv(information)[:, 0, 0].sqrt())


class TestCRLB(BaseTester):
    def test_smoke_any_mask_has_a_bound_in_double_precision(self, device, dtype):
        masks = PixelwiseMask(2).to(device, dtype)
        bound = crlb(PSFModel(masks.to(device), fidelity="draft"), [-5.0, 5.0])
        assert (bound.dtype, bound.device.type, bound.shape) == (torch.float64, device.type, (2,))
        bound.sum().backward()
        (gradient,) = (p.grad for p in masks.parameters())
        assert gradient is not None
        assert gradient.dtype == dtype
        assert bool(gradient.isfinite().all())
        assert bool((gradient != 0).any())

    @pytest.mark.parametrize("kind", ["flat", "cubic"])
    def test_feature_symmetric_images_tell_nothing_in_focus(self, kind):
        masks = PixelwiseMask(1, initial="flat") if kind == "flat" else CubicMask(15.0)
        bound = crlb(PSFModel(masks, fidelity="draft"), [-1.0, 0.0, 1.0])
        assert bound[1] == math.inf
        self.assert_close(bound[0], bound[2])
        bound[[0, 2]].sum().backward()
        assert all(bool(p.grad.isfinite().all()) for p in masks.parameters())

    def test_gradcheck(self):
        settings = FINE.replace(window=9)

        def bound(phase):
            lens = PSFModel(GivenPhase(phase), fidelity=settings, spectrum=Spectrum.monochrome())
            return crlb(lens, [-4.0, 2.0])

        self.gradcheck(bound, (torch.cat([smooth_mask(1), smooth_mask(2)]),))

    def test_gradcheck_sampled(self):
        def bound(phase):
            return defocus_bound(fisher_information(sampled_response(phase, APERTURE, [-4.0, 2.0], samples=32)))

        self.gradcheck(bound, (smooth_mask(),))
