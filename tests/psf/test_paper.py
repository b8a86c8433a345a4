from __future__ import annotations

import numpy as np
import pytest
import torch

from kornia_tidy import DefocusRange, PixelwiseMask, Spectrum, TiDyOptics
from kornia_tidy.optics import circular_aperture
from kornia_tidy.psf.paper import AliasingWarning, padded_size, paper_psf_bank, paper_psfs, warn_if_aliased
from tests.base import BaseTester, shared

NODES = tuple(np.linspace(-20, 20, 21).tolist())
WAVELENGTHS = (610e-9, 530e-9, 470e-9)


def bank_of(heights: torch.Tensor, nodes=NODES):
    phase = heights.double() * (2 * np.pi * 0.5 / 530e-9)
    weights = torch.full((len(heights),), 1 / len(heights), dtype=torch.float64)
    dispersion = [530e-9 / w for w in WAVELENGTHS]
    return paper_psf_bank(phase, weights, circular_aperture(23), Spectrum.rgb(), dispersion, nodes)


def rewritten(heights: np.ndarray, psi: float, wavelength: float, pad: int) -> np.ndarray:
    """The equations once more, as a direct sum over the pupil instead of an FFT."""
    x = (np.arange(23) - 11) / 10
    rho2 = x[:, None] ** 2 + x**2
    open_ = rho2 <= 1 + 1e-9
    u = (np.arange(23) - 11) / pad
    wave = np.exp(-2j * np.pi * u[:, None] * np.arange(23))
    total = 0
    for h in heights:
        field = open_ * np.exp(1j * (2 * np.pi / wavelength * 0.5 * h + psi * rho2 * 530e-9 / wavelength))
        total = total + np.abs(wave @ field @ wave.T) ** 2 / (pad**2 * open_.sum()) / len(heights)
    return total


class TestPaperPSFs(BaseTester):
    def test_feature_equals_the_equations_rewritten(self):
        heights = torch.rand(3, 23, 23, dtype=torch.float64) * 1.2e-6
        bank = bank_of(heights)
        for d in (0, 7, 10, 20):
            for c, (wavelength, pad) in enumerate(zip(WAVELENGTHS, (31, 27, 23), strict=True)):
                expected = torch.from_numpy(rewritten(heights.numpy(), NODES[d], wavelength, pad))
                assert float((bank.psfs[d, c] - expected).abs().max()) < 1e-12

    def test_feature_equals_the_published_file(self):
        folder = shared("data/masks/PhaseCam3D/trained_framework", {"HeightMap.txt": 1, "PSFs.npy": 1})
        heights = torch.from_numpy(np.loadtxt(folder / "HeightMap.txt"))[None]
        published = torch.from_numpy(np.load(folder / "PSFs.npy")).permute(0, 3, 1, 2)
        bank = bank_of(heights, tuple(np.linspace(-10, 10, 21).tolist()))
        assert float((bank.psfs - published).abs().max()) < 1e-7

    def test_feature_light_sums_to_one_before_the_crop_even_where_it_aliases(self):
        """In blue nothing is cropped: a sum of one says nothing about aliasing."""
        bank = bank_of(torch.rand(1, 23, 23) * 1.2e-6)
        self.assert_close(bank.energy[:, 2], torch.ones(21), rtol=1e-12, atol=1e-12)
        assert float(bank.energy.max()) <= 1 + 1e-12

    def test_feature_padded_sides(self):
        assert [padded_size(w) for w in WAVELENGTHS] == [31, 27, 23]
        with pytest.raises(ValueError, match="at least 453 nm, got 400 nm"):
            padded_size(400e-9)

    def test_gradcheck(self):
        aperture = circular_aperture(23)
        self.gradcheck(
            lambda p, w: paper_psfs(p, w, aperture, torch.tensor([-4.0, 9.0]), 610e-9, 0.9),
            (torch.rand(2, 23, 23), torch.tensor([0.3, 0.7])),
        )

    def test_exception_other_sizes(self):
        with pytest.raises(ValueError, match="23x23 pixels, got 32"):
            TiDyOptics(PixelwiseMask(1, 32), DefocusRange(-10, 10), fidelity="paper").psf_bank()


class TestAliasing(BaseTester):
    def test_feature_the_limit_is_14_7_in_blue(self):
        with pytest.warns(AliasingWarning, match=r"up to 14\.7 rad at 470 nm, but the range goes to 20\.0"):
            warn_if_aliased((-20.0, 20.0), Spectrum.rgb())
        warn_if_aliased((-14.6, 14.6), Spectrum.rgb())  # silent, or the test run would fail
        warn_if_aliased((-16.5, 16.5), Spectrum.monochrome())

    def test_feature_a_camera_warns_once_and_names_the_remedy(self, recwarn):
        with pytest.warns(AliasingWarning, match="fidelity='balanced'"):
            optics = TiDyOptics(camera=DefocusRange(-20, 20), fidelity="paper", sensor=None)
        recwarn.clear()
        optics(torch.rand(1, 3, 40, 40), torch.rand(1, 1, 40, 40))
        optics.psf_bank()
        assert len(recwarn) == 0
