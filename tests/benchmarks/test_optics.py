"""How long the smaller parts of the optics take."""

from __future__ import annotations

import pytest
import torch

from kornia_tidy import Fidelity, FresnelLens, PixelwiseMask, ThinLensCamera, TiDyOptics
from kornia_tidy.design import autocorrelation_bound
from kornia_tidy.masks import CubicMask, FourierMask, RadialMask, SpiralMask, ZernikeMask
from kornia_tidy.modulator import GreyLevels, PixelCrosstalk, SpatialLightModulator, Switching
from kornia_tidy.optics import camera_spectrum, circular_aperture


class TestOptics:
    def test_defocus(self, bench, scene):
        bench(lambda: ThinLensCamera().defocus(scene[1]))

    def test_circular_aperture_by_area(self, bench):
        bench(lambda: circular_aperture(92, 0.025, edges="area"), size=0, pupil=92)

    def test_camera_spectrum(self, bench):
        bench(lambda: camera_spectrum(samples=31), size=0, wavelengths=31)

    def test_fresnel_lens(self, bench):
        bench(FresnelLens, size=0, masks=1, pupil=23)

    @pytest.mark.parametrize("family", [ZernikeMask, RadialMask, SpiralMask, FourierMask, CubicMask])
    def test_phase_and_gradients(self, bench, device, family):
        masks = family(size=64).to(device)
        learnt, count = list(masks.parameters()), len(masks.phase)
        bench(lambda: torch.autograd.grad(masks.phase.square().sum(), learnt), size=0, masks=count, pupil=64)

    @pytest.mark.parametrize("between", ["random", "exponential"])
    def test_modulator(self, bench, device, between):
        modulator = SpatialLightModulator(GreyLevels(8), PixelCrosstalk(0.2), Switching(4e-3, between=between))
        phase = PixelwiseMask(5).phase.detach().to(device)
        bench(lambda: modulator(phase), size=0, masks=5, pupil=23)

    def test_autocorrelation_bound(self, bench):
        phase, aperture = PixelwiseMask(5).phase.detach(), circular_aperture(23)
        bench(lambda: autocorrelation_bound(phase, aperture), size=0, masks=5, pupil=23)

    def test_window_fitted_to_new_masks(self, bench, device):
        optics = TiDyOptics(PixelwiseMask(5), fidelity=Fidelity("draft", enclosed_energy=0.6)).to(device)
        with torch.no_grad():
            bench(optics.fit_window, size=0, masks=5, layers=3, window=optics.window, wavelengths=3, pupil=23)
