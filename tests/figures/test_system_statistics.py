from __future__ import annotations

import math

import pytest
import torch

from kornia_tidy import TiDyOptics
from kornia_tidy.figures.system_statistics import contrast_transfer, system_statistics
from tests.base import BaseTester


class TestContrastTransfer(BaseTester):
    def test_feature_a_gaussians_is_a_gaussian(self, dtype):
        """exp(-2 pi^2 sigma^2 f^2), whatever the direction; a ring's mean is that of its middle within its width."""
        x = torch.arange(41, dtype=dtype) - 20
        psf = torch.exp(-(x[:, None] ** 2 + x**2) / (2 * 1.5**2))
        contrast = contrast_transfer((psf / psf.sum())[None], 32)[0]
        middle = (torch.arange(32, dtype=dtype) + 0.5) / 64
        expected = torch.exp(-2 * (math.pi * 1.5 * middle) ** 2)
        self.assert_close(contrast[1:], expected[1:], rtol=0, atol=0.01)

    def test_feature_does_not_care_where_a_psf_is_or_how_it_is_turned(self, dtype):
        psf = torch.rand(2, 3, 9, 9, dtype=dtype)
        moved = torch.nn.functional.pad(psf, (5, 1, 0, 6))
        self.assert_close(contrast_transfer(moved), contrast_transfer(psf), rtol=1e-4, atol=1e-5)
        self.assert_close(contrast_transfer(psf.rot90(1, (2, 3))), contrast_transfer(psf), rtol=1e-4, atol=1e-5)


class TestSystemStatistics(BaseTester):
    @pytest.mark.parametrize("name", ["phasecam3d", "chang2019"])
    def test_smoke_shapes_and_ranges(self, name):
        optics = TiDyOptics.from_preset(name)
        seen = system_statistics(optics, nodes=5, frequencies=8)
        assert seen.defocus[[0, -1]].tolist() == pytest.approx(optics.camera.defocus_range)
        assert seen.psfs.shape == (5, 3, optics.window, optics.window)
        self.assert_close(seen.psfs.sum((2, 3)), torch.ones(5, 3), rtol=0, atol=1e-5)
        assert seen.contrast.shape == (5, 3, 8)
        assert 0 <= float(seen.contrast.min()) < float(seen.contrast.max()) <= 1 + 1e-6
        assert seen.bound.shape == (5,)
        assert not seen.psfs.requires_grad
