from __future__ import annotations

import pytest
import torch
from torch import nn

from kornia_tidy.masks import PhaseMasks, PixelwiseMask, adam_groups, mask_axes, metres_to_radians
from kornia_tidy.masks.base import initial_values
from kornia_tidy.optics import FUSED_SILICA, constant_index
from tests.base import BaseTester


class TestPhaseMasks(BaseTester):
    def test_feature_dispersion_is_colour_times_index(self):
        """Phase is 2 pi (n - 1) h / lambda: for a constant index it goes as 1 / lambda."""
        assert PixelwiseMask().dispersion(470e-9) == pytest.approx(530 / 470)
        silica = PixelwiseMask(material=FUSED_SILICA).dispersion(470e-9)
        assert silica == pytest.approx(530 / 470 * 0.46415 / 0.46080, rel=1e-4)

    def test_feature_a_family_of_ones_own_needs_only_a_parameter(self):
        class Step(PhaseMasks):
            def __init__(self):
                super().__init__(constraint="wrapped")
                self.phase = nn.Parameter(torch.tensor([[[1.0, 7.0]]]))

        masks = Step()
        assert list(masks.state_dict()) == ["phase"]
        self.assert_close(masks.phase, torch.tensor([[[1.0, 7.0 - 6.2831853]]]))

    def test_smoke_repr_tells_the_masks(self):
        assert "5 learnable masks of 23x31 pixels, constant index 1.5" in repr(PixelwiseMask(size=(23, 31)))
        assert "clamp to 1.2 um" in repr(PixelwiseMask(constraint="clamp", max_height=1.2e-6))

    @pytest.mark.parametrize(
        ("options", "message"),
        [
            ({"constraint": "tight"}, "constraint must be one of 'none', 'clamp', 'sigmoid', 'wrapped', got 'tight'"),
            ({"constraint": "clamp", "max_height": -1e-6}, "max_height must be positive and finite metres, got -1e-06"),
            ({"max_height": 1e-6}, "max_height needs a constraint, .* got 1e-06"),
        ],
    )
    def test_exception_limits(self, options, message):
        with pytest.raises(ValueError, match=message):
            PixelwiseMask(**options)


class TestMaskAxes(BaseTester):
    def test_feature_pixels_are_square_and_the_shorter_side_spans_the_mask(self):
        y, x = mask_axes((46, 68))
        self.assert_close(y.flatten().diff(), torch.full((45,), 0.05).double())
        self.assert_close(x.diff(), torch.full((67,), 0.05).double())
        assert float(y.sum()) == pytest.approx(0, abs=1e-12)

    def test_exception_size(self):
        with pytest.raises(ValueError, match="size must be positive"):
            mask_axes((23, 0))
        with pytest.raises(ValueError, match="both be odd or both even, got 23 and 24"):
            mask_axes((23, 24))


class TestInitialValues(BaseTester):
    def test_feature_noise_has_the_root_mean_square(self):
        values = initial_values("noise", 4, (100, 100), 2.0, None)
        assert float(values.square().mean().sqrt()) == pytest.approx(2.0, rel=0.01)

    @pytest.mark.parametrize("initial", [torch.zeros(2, 4), torch.zeros(0, 3), torch.tensor([0.0, 1.0, float("nan")])])
    def test_exception_values(self, initial):
        with pytest.raises(ValueError, match="initial values must"):
            initial_values(initial, 5, (3,), 1.0, None)

    def test_exception_name(self):
        with pytest.raises(ValueError, match="initial must be one of 'noise', 'flat', got 'nois'"):
            initial_values("nois", 5, (3,), 1.0, None)


class TestAdamGroups(BaseTester):
    def test_feature_radians_a_metre(self):
        assert metres_to_radians(constant_index(1.5)) * 1e-8 == pytest.approx(0.0593, abs=1e-4)

    def test_exception_learning_rate(self):
        with pytest.raises(ValueError, match="lr_metres must be positive"):
            adam_groups(PixelwiseMask(), 0.0)
