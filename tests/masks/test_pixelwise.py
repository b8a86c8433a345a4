from __future__ import annotations

import math

import pytest
import torch

from kornia_tidy import PixelwiseMask
from kornia_tidy.optics import FUSED_SILICA, constant_index
from kornia_tidy.psf import PSFModel
from tests.base import BaseTester

TWO_MASKS = {"pixelwise": lambda **o: PixelwiseMask(2, **o)}
ONE_MASK = {
    "flat": lambda g: PixelwiseMask(1, initial="flat"),
    "random": lambda g: PixelwiseMask(1, generator=g),
    "random, 3 um": lambda g: PixelwiseMask(initial=3e-6 * torch.rand(1, 23, 23, generator=g, dtype=torch.float32)),
}


class TestPixelwiseMask(BaseTester):
    def test_cardinality(self):
        for masks, size in ((1, 23), (5, 23), (3, 64)):
            assert PixelwiseMask(masks, size).phase.shape == (masks, size, size)
        assert PixelwiseMask(initial=torch.zeros(7, 7)).phase.shape == (1, 7, 7)

    def test_feature_noise_is_the_start_of_the_paper(self):
        heights = PixelwiseMask(20, 64).heights().detach()
        assert 0 <= float(heights.min()) < 0.01e-6
        assert 1.19e-6 < float(heights.max()) <= 1.2e-6
        assert float(heights.mean()) == pytest.approx(0.6e-6, rel=0.01)

    def test_feature_given_heights_come_back(self):
        heights = torch.rand(2, 23, 23) * 1e-6
        for material in (constant_index(1.5), FUSED_SILICA):
            self.assert_close(PixelwiseMask(initial=heights, material=material).heights(), heights, rtol=1e-6, atol=0)

    @pytest.mark.parametrize(
        "initial", ["nois", None, torch.zeros(3), torch.zeros(0, 4, 4), torch.full((4, 4), math.nan)]
    )
    def test_exception_initial(self, initial):
        with pytest.raises((TypeError, ValueError), match="initial"):
            PixelwiseMask(initial=initial)

    def test_feature_given_heights_come_back_within_a_constraint(self):
        heights = torch.rand(2, 23, 31) * 0.9e-6 + 0.05e-6
        for constraint in ("none", "clamp", "sigmoid", "wrapped"):
            back = PixelwiseMask(initial=heights, constraint=constraint).heights().detach()
            self.assert_close(back, heights, rtol=1e-5, atol=1e-12)

    def test_feature_light_passes_through_the_middle_of_a_longer_mask(self):
        heights = torch.rand(2, 23, 23) * 1e-6
        wide = torch.rand(2, 23, 41) * 1e-6
        wide[..., 9:32] = heights
        banks = [PSFModel(PixelwiseMask(initial=h)).psf_bank(defocus=[-3.0]) for h in (heights, wide, wide.mT)]
        self.assert_close(banks[1].psfs, banks[0].psfs, rtol=0, atol=1e-7)
        self.assert_close(banks[2].psfs, banks[0].psfs.mT, rtol=0, atol=1e-5)

    @pytest.mark.parametrize(
        ("options", "sentence"),
        [
            ({"num_masks": 10**6}, "num_masks must be at most 10000 for masks of 529 pixels, got 1000000"),
            ({"num_masks": 100, "size": 4096}, "num_masks must be at most 16 for masks of 16777216 pixels, got 100"),
            ({"size": 10**6}, "a mask must have at most 268435456 pixels, got 1000000 x 1000000"),
        ],
    )
    def test_exception_more_than_memory_is_meant_for(self, options, sentence):
        with pytest.raises(ValueError, match=sentence):
            PixelwiseMask(**options)

    def test_exception_a_part_of_a_mask(self):
        with pytest.raises(TypeError, match=r"num_masks must be a whole number, got the number 1\.5"):
            PixelwiseMask(1.5)

    def test_exception_a_mask_that_cannot_be_centred(self):
        with pytest.raises(ValueError, match="rows and columns of a mask must both be odd or both even, got 4 and 3"):
            PixelwiseMask(initial=torch.zeros(2, 4, 3))
