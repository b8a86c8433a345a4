from __future__ import annotations

import math

import pytest
import torch

from kornia_tidy import Fidelity, PixelwiseMask, PSFBank, Spectrum, ThinLensCamera
from kornia_tidy.lab.calibration.psf import fit_masks, retrieve_mask
from kornia_tidy.lab.calibration.psf.phase_retrieval import one_height
from kornia_tidy.masks import ZernikeMask
from kornia_tidy.psf import PSFModel
from tests.base import BaseTester

SMALL = Fidelity("small", window=17)
GREEN = Spectrum.monochrome()


def smooth_mask(size=11):
    strengths = 0.5 * torch.randn(15, generator=torch.Generator().manual_seed(2))
    return PixelwiseMask(1, initial=ZernikeMask(1, size, 15, initial=strengths).heights().detach())


def bank_of(masks, nodes=(-6.0, 0.0, 6.0), spectrum=GREEN):
    with torch.no_grad():
        return PSFModel(masks, fidelity=SMALL, spectrum=spectrum).psf_bank(defocus=nodes)


class TestFitMasks(BaseTester):
    def test_feature_a_mask_is_found_from_a_flat_one(self):
        start = PSFModel(PixelwiseMask(1, 11, "flat"), fidelity=SMALL, spectrum=GREEN)
        fit = fit_masks(bank_of(smooth_mask()), start, iterations=60)
        assert float(fit.residual.max()) < 1e-2
        self.assert_close(fit.shifts, torch.zeros(3, 2), rtol=0, atol=5e-3)

    def test_feature_depths_that_lie_off_their_centre_are_put_right(self):
        """Shifts by whole pixels need no interpolation; their mean is zero, so no tilt of the mask can replace them."""
        bank = bank_of(smooth_mask())
        moved = torch.stack(
            [torch.roll(psf, shift, (1, 2)) for psf, shift in zip(bank.psfs, [(0, 0), (1, 0), (0, -1)], strict=True)]
        )
        start = PSFModel(smooth_mask(), fidelity=SMALL, spectrum=GREEN)
        fit = fit_masks(PSFBank(moved, bank.defocus, bank.energy), start, iterations=60)
        wanted = torch.tensor([(0.0, 0.0), (1.0, 0.0), (0.0, -1.0)])
        self.assert_close(fit.shifts, wanted - wanted.mean(0), rtol=0, atol=0.05)

    @pytest.mark.parametrize("offset", [-1.3, 2.0])
    def test_feature_of_a_known_mask_the_focus_is_found(self, offset):
        masks = smooth_mask().requires_grad_(False)
        shown = bank_of(masks, (-6.0 + offset, offset, 6.0 + offset))
        assumed = PSFBank(shown.psfs, torch.tensor([-6.0, 0.0, 6.0]), shown.energy)
        fit = fit_masks(assumed, PSFModel(masks, fidelity=SMALL, spectrum=GREEN), iterations=60)
        assert fit.defocus_offset == pytest.approx(offset, abs=0.02)
        assert float(fit.residual.max()) < 0.02

    def test_exception_other_channels(self):
        with pytest.raises(ValueError, match="the spectrum has 3 channels, the measured PSFs 1"):
            fit_masks(bank_of(smooth_mask()), PSFModel(smooth_mask(), fidelity=SMALL))
        with pytest.raises(ValueError, match="iterations must be positive"):
            fit_masks(bank_of(smooth_mask()), PSFModel(smooth_mask(), fidelity=SMALL, spectrum=GREEN), 0)


class TestRetrieveMask(BaseTester):
    def test_exception_one_depth(self):
        bank = PSFBank.from_measured(torch.rand(1, 1, 9, 9), torch.zeros(1))
        with pytest.raises(ValueError, match="PSFs at two depths or more"):
            retrieve_mask(bank, ThinLensCamera(), GREEN, 11)

    @pytest.mark.parametrize("waves", [1.0, 2.5])
    def test_feature_one_height_of_several_wavelengths(self, waves):
        generator = torch.Generator().manual_seed(0)
        truth = torch.rand(9, 9, generator=generator) * waves * 2 * math.pi
        factors = [1.0, 530 / 610, 530 / 470]
        phases = [(truth * s + c) % (2 * math.pi) for s, c in zip(factors, (0.3, 2.0, 5.0), strict=True)]
        found = one_height(phases, factors)
        difference = found - truth
        self.assert_close(difference, difference.mean().expand(9, 9), rtol=0, atol=1e-3)
