from __future__ import annotations

import numpy as np
import pytest
import torch

from kornia_tidy.masks import RadialMask, mask_axes
from tests.base import BaseTester
from tests.masks.strong import strong

TWO_MASKS = {"radial": lambda **o: RadialMask(2, **o)}
ONE_MASK = {
    "radial": lambda g: RadialMask(1, generator=g),
    "strong radial": lambda g: strong(RadialMask(1, generator=g), 4),
}
OVER_PUPIL = True


class TestRadialMask(BaseTester):
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
