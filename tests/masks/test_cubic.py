from __future__ import annotations

import math

import pytest
import torch

from kornia_tidy import Spectrum
from kornia_tidy.masks import CubicMask, mask_axes
from kornia_tidy.psf import Pupil, exact_psf_bank
from tests.base import BaseTester

TWO_MASKS = {"cubic": lambda **o: CubicMask([4.0, -3.0], **o)}
ONE_MASK = {
    "weak cubic": lambda g: CubicMask(5.0),
    "cubic": lambda g: CubicMask(),
    "strong cubic": lambda g: CubicMask(80.0),
}
OVER_PUPIL = True


class TestCubicMask(BaseTester):
    def test_feature_modulation_is_that_of_dowski_and_cathey_whatever_the_defocus(self):
        """A square pupil has the modulation sqrt(pi / (12 alpha u)) at a pupil shift u; its edges add a ripple."""
        masks, step = CubicMask(30.0, 345), 0.1
        open_ = (mask_axes(345)[1].abs() < 1).double()
        pupil, one = Pupil(open_[:, None] * open_, 2.3 / 345), torch.ones(1)
        phase, defocus = masks.phase.detach().double(), [-10.0, 0.0, 10.0]
        bank = exact_psf_bank(phase, one, pupil, Spectrum.monochrome(), [1.0], defocus, step * 530e-9, 481, 0.1)
        line = bank.psfs[:, 0].sum(1)
        shift = torch.linspace(0.3, 1.2, 91, dtype=torch.float64)
        wave = torch.exp(2j * math.pi * shift[:, None] * step * torch.arange(-240, 241))
        modulation = (line.to(wave) @ wave.T).abs()
        expected = (math.pi / (12 * 30 * shift)).sqrt()
        ratio = modulation / expected
        self.assert_close(ratio.mean(1), torch.ones(3).double(), rtol=0, atol=0.05)
        assert float(ratio.min()) > 0.7

    def test_feature_one_mask_for_each_strength(self):
        phase = CubicMask([3.0, -5.0]).phase.detach()
        assert float(phase[0, 21, 21]) == pytest.approx(6, abs=1e-5)
        assert float(phase[1, 11, 1]) == pytest.approx(5, abs=1e-5)

    @pytest.mark.parametrize("strength", [[], float("nan"), [1.0, float("inf")]])
    def test_exception_strength(self, strength):
        with pytest.raises(ValueError, match="strength must be one finite number of radians for each mask"):
            CubicMask(strength)
