from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.ndimage import rotate

from kornia_tidy.masks.base import mask_axes
from kornia_tidy.masks.radial import RadialMask
from tests.base import BaseTester
from tests.masks.strong import strong

TWO_MASKS = {"radial": lambda **o: RadialMask(2, **o)}
ONE_MASK = {
    "radial": lambda g: RadialMask(1, generator=g),
    "strong radial": lambda g: strong(RadialMask(1, generator=g), 4),
}
OVER_PUPIL = True


class TestRadialMask(BaseTester):
    @pytest.mark.parametrize("size", [23, 64])
    def test_feature_symmetric_under_quarter_turns_and_transposition(self, size):
        phase = RadialMask(3, size).phase.detach()
        for turned in (phase.rot90(1, (1, 2)), phase.rot90(2, (1, 2)), phase.mT, phase.flip(1)):
            self.assert_close(turned, phase, rtol=0, atol=1e-6)

    def test_feature_nearly_symmetric_under_any_turn(self):
        """Rotated by SciPy, whose interpolation between pixels limits the agreement."""
        profile = 5 * torch.cos(torch.linspace(0, 6, 41))
        phase = RadialMask(size=160, num_radii=41, initial=profile).phase[0].detach().numpy()
        y, x = mask_axes(160)
        inside = (torch.hypot(y, x) < 0.95).numpy()
        for degrees in (10, 33, 71):
            turned = rotate(phase, degrees, reshape=False, order=1)
            assert np.abs(turned - phase)[inside].max() < 0.03

    def test_feature_linear_between_the_radii_and_constant_beyond(self):
        radii, profile = np.linspace(0, 1, 6), np.array([0.3, -1.0, 2.0, 0.5, 0.0, 4.0])
        y, x = mask_axes((23, 31))
        expected = np.interp(torch.hypot(y, x).numpy(), radii, profile)
        phase = RadialMask(size=(23, 31), num_radii=6, initial=torch.from_numpy(profile)).phase[0]
        self.assert_close(phase, torch.from_numpy(expected), rtol=0, atol=1e-5)

    def test_feature_as_many_radii_as_pixels_along_one(self):
        assert RadialMask(size=23).profile.shape == (5, 11)
        assert RadialMask(2, 256).profile.shape == (2, 113)

    def test_exception_one_radius(self):
        with pytest.raises(ValueError, match="num_radii must be at least 2, got 1"):
            RadialMask(num_radii=1)
