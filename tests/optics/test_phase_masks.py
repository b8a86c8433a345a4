from __future__ import annotations

import math

import pytest
import torch

from kornia_tidy.optics.materials import FUSED_SILICA, constant_index
from kornia_tidy.optics.phase_masks import (
    FresnelLens,
    PixelwiseMask,
    adam_groups,
    mask_coordinates,
    metres_to_radians,
)
from tests.base import BaseTester


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

    def test_feature_the_generator_decides(self):
        one, two = (PixelwiseMask(generator=torch.Generator().manual_seed(3)).phase for _ in range(2))
        assert torch.equal(one, two)

    def test_feature_half_precision_keeps_the_height(self):
        """Radians survive a cast to half; metres of order 1e-7 would not."""
        masks = PixelwiseMask()
        before = masks.heights().detach()
        after = masks.half().heights().detach()
        assert after.dtype == torch.float32
        assert float((after - before).abs().max()) < 1e-9

    @pytest.mark.parametrize(
        "initial", ["nois", torch.zeros(2, 3, 4), torch.zeros(0, 4, 4), torch.full((4, 4), math.nan)]
    )
    def test_exception_initial(self, initial):
        with pytest.raises(ValueError, match="initial"):
            PixelwiseMask(initial=initial)

    def test_feature_dispersion_is_colour_times_index(self):
        """Phase is 2 pi (n - 1) h / lambda: for a constant index it goes as 1 / lambda."""
        assert PixelwiseMask().dispersion(470e-9) == pytest.approx(530 / 470)
        silica = PixelwiseMask(material=FUSED_SILICA).dispersion(470e-9)
        assert silica == pytest.approx(530 / 470 * 0.46415 / 0.46080, rel=1e-4)


class TestFresnelLens(BaseTester):
    def test_feature_equals_defocus_up_to_whole_waves(self):
        lens = FresnelLens(defocus=10.0)
        x = (torch.arange(23) - 11) * 0.1
        difference = torch.remainder(lens.phase[0] - 10 * (x[:, None] ** 2 + x**2) + 0.5, 2 * math.pi) - 0.5
        assert float(difference.abs().max()) < 1e-5

    def test_feature_is_not_learnable_but_travels(self):
        lens = FresnelLens()
        assert list(lens.parameters()) == []
        assert "phase" in lens.state_dict()

    def test_feature_steps_stay_below_half_a_wave_inside_the_aperture(self):
        x = mask_coordinates(23)[1:-1]
        quadratic = 10 * x**2
        assert float(quadratic.diff().abs().max()) < math.pi


class TestAdamGroups(BaseTester):
    def test_feature_one_step_moves_the_height_by_the_learning_rate(self):
        masks = PixelwiseMask(1)
        before = masks.heights().detach().clone()
        optimizer = torch.optim.Adam([adam_groups(masks, 1e-8)], betas=(0.99, 0.999))
        (masks.phase * 2.5e-8).sum().backward()  # the median gradient of the point-PSF task
        optimizer.step()
        moved = (before - masks.heights()).detach()
        assert float(moved.min()) == pytest.approx(1e-8, rel=0.01)

    def test_feature_radians_a_metre(self):
        assert metres_to_radians(constant_index(1.5)) * 1e-8 == pytest.approx(0.0593, abs=1e-4)

    def test_exception_learning_rate(self):
        with pytest.raises(ValueError, match="lr_metres must be positive"):
            adam_groups(PixelwiseMask(), 0.0)
