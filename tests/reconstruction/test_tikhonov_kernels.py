"""Inverse kernels of bounded size, against the closed form of whole images."""

from __future__ import annotations

import pytest
import torch

from kornia_tidy.reconstruction.tikhonov import tikhonov
from kornia_tidy.reconstruction.tikhonov_kernels import tikhonov_kernels
from tests.base import BaseTester


def blurs(side=7, dtype=torch.float64):
    """A Gaussian, off centre, and a random PSF that cannot be inverted stably."""
    x = torch.arange(side, dtype=dtype) - side // 2
    bell = (-0.5 * (x[:, None] - 1).square() - 0.3 * x.square()).exp()
    noise = torch.rand(side, side, dtype=dtype, generator=torch.Generator().manual_seed(0))
    return torch.stack([psf / psf.sum() for psf in (bell, noise)])


class TestTikhonovKernels(BaseTester):
    def test_feature_they_are_the_closed_form_within_their_window(self):
        """The answer to a point in an empty surround is the kernel, where nothing wraps around."""
        capture = torch.zeros(1, 2, 243, 243, dtype=torch.float64)
        capture[..., 121, 121] = 1.0
        for weight in (0.1, 0.5):
            found = tikhonov_kernels(blurs(), (weight,))[0]
            whole = tikhonov(capture, blurs(), weight, prior=capture, border="circular")[0]
            inside = whole[..., 110:133, 110:133]
            added = (1 - inside.sum((-2, -1), keepdim=True)) / 23**2  # so that the sum is one
            self.assert_close(found, inside + added, atol=1e-5, rtol=0)

    def test_feature_white_becomes_white(self):
        """A window that holds 80 % of the light makes white 0.8."""
        expected = torch.full((2, 2), 1 / 0.8, dtype=torch.float64)
        self.assert_close(tikhonov_kernels(0.8 * blurs(), (1e-3, 0.1)).sum((-2, -1)), expected)

    def test_gradcheck(self, device):
        self.gradcheck(lambda psf: tikhonov_kernels(psf, (0.05,)), (blurs(5)[:1].to(device),))

    def test_exception(self):
        with pytest.raises(ValueError, match=r"psf must have shape \(C, P, P\) with P odd, got \(1, 4, 4\)"):
            tikhonov_kernels(torch.rand(1, 4, 4), (0.1,))
        with pytest.raises(ValueError, match="weight must be positive and finite, got 0"):
            tikhonov_kernels(torch.rand(1, 3, 3), (0.0,))
        with pytest.raises(TypeError, match="psf must be floating point"):
            tikhonov_kernels(torch.ones(1, 3, 3, dtype=torch.int64), (0.1,))
