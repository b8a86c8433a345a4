"""Wiener kernels of bounded size, against the Wiener restoration of whole images."""

from __future__ import annotations

import pytest
import torch

from kornia_tidy.data import SceneStatistics
from kornia_tidy.reconstruction.wiener import wiener
from kornia_tidy.reconstruction.wiener_kernels import wiener_kernels
from tests.base import BaseTester

EVEN = SceneStatistics(exponent=2.9, knee=1 / 32, mean=0.3, spread=0.2)  # all depths alike; kernels decay sooner
FAR = SceneStatistics(exponent=2.9, knee=1 / 32, mean=0.3, spread=0.2, depths=(1.0, 0.0))


def blurs(depths=3, side=7, dtype=torch.float64):
    """Bells of two colours whose width grows with depth, off centre."""
    x = torch.arange(side, dtype=dtype) - side // 2
    widths = torch.linspace(0.6, 2.0, 2 * depths, dtype=dtype).view(depths, 2, 1, 1)
    psfs = (-((x[:, None] - 1).square() + x.square()) / (2 * widths.square())).exp()
    return psfs / psfs.sum((-2, -1), keepdim=True)


class TestWienerKernels(BaseTester):
    def test_feature_they_are_the_filter_within_their_window(self):
        """The answer to a point in an empty surround is the kernel, where nothing wraps around. Planes of both differ
        in size, and with them the sampling of the spectrum: by what a kernel holds beyond the smaller plane."""
        capture = torch.zeros(1, 2, 243, 243, dtype=torch.float64)
        capture[..., 121, 121] = 1.0
        for noise in (0.01, 0.05):
            found = wiener_kernels(blurs(), (noise,), EVEN)[0]
            whole = wiener(
                capture, blurs(), noise, EVEN, depth_weights=torch.tensor([0.25, 0.5, 0.25]), border="circular"
            )
            inside = whole[0, :, 110:133, 110:133]
            added = (1 - inside.sum((-2, -1), keepdim=True)) / 23**2  # so that the sum is one
            self.assert_close(found, inside + added, atol=1e-4 * float(inside.amax()), rtol=0)

    def test_feature_depths_count_by_the_statistics(self):
        self.assert_close(wiener_kernels(blurs(2), (0.01,), FAR), wiener_kernels(blurs(2)[:1], (0.01,), FAR))

    def test_feature_white_becomes_white(self):
        """A window that holds 80 % of the light makes white 0.8."""
        expected = torch.full((2, 2), 1 / 0.8, dtype=torch.float64)
        self.assert_close(wiener_kernels(0.8 * blurs(), (1e-3, 0.1)).sum((-2, -1)), expected)

    def test_gradcheck(self, device):
        self.gradcheck(lambda psfs: wiener_kernels(psfs, (0.05,)), (blurs(2, 5).to(device),))

    def test_exception(self):
        with pytest.raises(ValueError, match=r"psfs must have shape \(D, C, P, P\) with P odd, got \(2, 1, 4, 4\)"):
            wiener_kernels(torch.rand(2, 1, 4, 4), (0.1,))
        with pytest.raises(ValueError, match="noise must be positive and finite, got 0"):
            wiener_kernels(torch.rand(2, 1, 3, 3), (0.0,))
        with pytest.raises(TypeError, match="psfs must be floating point"):
            wiener_kernels(torch.ones(2, 1, 3, 3, dtype=torch.int64), (0.1,))
