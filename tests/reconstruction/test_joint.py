"""Depth and image by name."""

from __future__ import annotations

import pytest
import torch

from kornia_tidy.reconstruction import AttentionUNet, JointHead, UncertainJointEstimate
from tests.base import BaseTester
from tests.reconstruction.test_head import SeeingHead


class TestJointHead(BaseTester):
    def test_convention_depth_is_the_first_channel(self, device, dtype):
        maps = torch.rand(2, 4, 8, 8, device=device, dtype=dtype)
        depth, image = JointHead(SeeingHead(4, 4))(maps)
        assert torch.equal(depth, maps[:, :1])
        assert torch.equal(image, maps[:, 1:])

    def test_feature_more_channels_are_a_distribution_of_depth(self):
        maps = torch.zeros(2, 6, 8, 8)
        maps[:, :3] = torch.tensor([2.0, 1.0, 1.0]).log().view(3, 1, 1)  # not negative, as a capture is
        estimate = JointHead(SeeingHead(6, 6))(maps)
        assert isinstance(estimate, UncertainJointEstimate)
        assert torch.equal(estimate.image, maps[:, 3:])
        self.assert_close(estimate.depth, torch.full((2, 1, 8, 8), 0.375))
        self.assert_close(estimate.deviation.square(), torch.full((2, 1, 8, 8), 0.0625 + 0.25 - 0.375**2))

    def test_exception_names_the_outputs(self):
        with pytest.raises(ValueError, match="network must have 4 outputs, depth and three colours, got 3"):
            JointHead(AttentionUNet(width=2))
