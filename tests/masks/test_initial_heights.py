from __future__ import annotations

import pytest
import torch

from kornia_tidy import PixelwiseMask
from kornia_tidy.choices import STARTS
from kornia_tidy.masks.initial_heights import CLEAN, SMALL_NOISE, SWEEP, fisher_mask, initial_heights
from kornia_tidy.psf import PSFModel
from tests.base import BaseTester
from tests.design.published_setting import design_fisher_mask


def drawn(start, seed=0):
    return initial_heights(start, torch.Generator().manual_seed(seed))


class TestFisherMask(BaseTester):
    @pytest.mark.takes_seconds
    def test_feature_is_what_the_design_finds(self):
        """Against the design itself; the constants are rounded to four decimals, which is 1e-11 m of height."""
        mask, bound = design_fisher_mask(seed=3)
        heights = mask.heights()[0].detach()
        self.assert_close(fisher_mask(), heights - heights.min(), rtol=0, atol=2e-10)
        assert bound < 0.067  # rad; the mask published with PhaseCam3D has 0.0785

    def test_feature_finer_grids_hold_the_same_surface(self):
        """69 pixels are three for each of 23, and the middle ones have the same centres."""
        fine, coarse = fisher_mask(69)[1::3, 1::3], fisher_mask()
        self.assert_close(fine - fine[11, 11], coarse - coarse[11, 11], rtol=0, atol=1e-15)

    def test_cardinality(self):
        heights = fisher_mask()
        assert (heights.shape, heights.dtype) == ((23, 23), torch.float64)
        assert float(heights.min()) == 0
        assert 7.0e-7 < float(heights.max()) < 7.2e-7


class TestInitialHeights(BaseTester):
    @pytest.mark.parametrize("start", STARTS)
    def test_smoke_masks_start_from_them(self, start):
        heights = drawn(start)
        masks = PixelwiseMask(initial=heights)
        self.assert_close(masks.heights().double(), heights, rtol=1e-5, atol=1e-12)
        assert heights.shape == (5, 23, 23)
        assert torch.equal(heights, drawn(start))
        assert torch.equal(heights, drawn(start, seed=1)) == (start == "flat")

    def test_feature_flat_masks_have_no_height(self):
        assert not drawn("flat").any()

    def test_feature_noise_is_uniform(self):
        noise = drawn("noise")
        assert 0 <= float(noise.min()) < 1e-8
        assert 1.19e-6 < float(noise.max()) <= 1.2e-6
        self.assert_close(noise.mean(), torch.tensor(0.6e-6), rtol=0.03)

    def test_feature_one_fisher_and_noise(self):
        heights = drawn("fisher, noise")
        assert torch.equal(heights[0], fisher_mask())
        assert torch.equal(heights[1:], drawn("noise")[1:])

    @pytest.mark.parametrize(("start", "clean"), CLEAN.items())
    def test_feature_quarter_turns_and_the_papers_noise(self, start, clean):
        heights = drawn(start)
        noise = torch.stack([heights[k].rot90(-k) - fisher_mask() for k in range(5)])
        assert not (noise[:clean].abs() > 1e-20).any()
        self.assert_close(noise[clean:].mean((1, 2)), torch.full((5 - clean,), 5.35e-7), rtol=0, atol=5e-8)
        self.assert_close(noise[clean:].std((1, 2)), torch.full((5 - clean,), 3.05e-7), rtol=0, atol=3e-8)
        assert len({round(float(one.sum()), 12) for one in noise[clean:]}) == 5 - clean  # all differ

    def test_feature_fishers_that_are_alike_but_for_little_noise(self):
        noise = drawn("like fishers") - fisher_mask()
        assert not noise[0].any()
        self.assert_close(noise[1:].std((1, 2)), torch.full((4,), 6e-8), rtol=0.1)

    def test_feature_each_of_a_sweep_is_sharp_at_its_own_defocus(self):
        depths = torch.arange(-20.0, 21.0).tolist()
        sharpest = []
        for heights in drawn("focal sweep"):
            psfs = PSFModel(PixelwiseMask(initial=heights[None])).psf_bank(1, defocus=depths).psfs
            sharpest.append(depths[int(psfs.amax((1, 2, 3)).argmax())])
        self.assert_close(torch.tensor(sharpest), torch.tensor(SWEEP), rtol=0, atol=1.0)  # rad; the noise shifts them

    @pytest.mark.parametrize("start", STARTS)
    def test_cardinality_masks_of_more_pixels(self, start):
        heights = initial_heights(start, torch.Generator().manual_seed(0), size=46)
        assert heights.shape == (5, 46, 46)
        assert bool(heights.isfinite().all())

    def test_feature_a_sweep_of_more_pixels_is_the_same_but_finer(self):
        coarse, fine = drawn("focal sweep"), initial_heights("focal sweep", torch.Generator().manual_seed(0), size=69)
        apart = fine[:, 1::3, 1::3] - coarse  # of three pixels one has its centre where the coarse one has
        assert apart.abs().max() < 7 * 2**0.5 * SMALL_NOISE  # seven standard deviations of the noise of both

    def test_exception_unknown_start(self):
        with pytest.raises(ValueError, match=r"start must be one of 'noise', 'fisher, noise', .*, got 'tetrapod'"):
            initial_heights("tetrapod")
