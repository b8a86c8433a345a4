"""Classes of depth averaged over neighbours of like colour."""

from __future__ import annotations

import pytest
import torch
from kornia.filters import guided_blur
from torch.nn import functional

from kornia_tidy.reconstruction.guided_classes import EDGE, RADIUS, VOTE, linear_fit, smoothed_classes
from tests.base import BaseTester


def maps(height=48, width=64, classes=5, dtype=torch.float64, seed=0):
    generator = torch.Generator().manual_seed(seed)
    logits = 3 * torch.randn(2, classes, height, width, generator=generator, dtype=torch.float64)
    return logits.to(dtype), torch.rand(2, 3, height, width, generator=generator, dtype=torch.float64).to(dtype)


class TestSmoothedClasses(BaseTester):
    def test_feature_the_fit_is_that_of_kornias_guided_filter(self):
        """Away from the border, where kornia reflects."""
        logits, guide = maps(40, 44)
        probability, side = logits.softmax(1), 2 * RADIUS + 1
        slopes, offset = linear_fit(probability, guide)
        found = offset + sum(slope * colour for slope, colour in zip(slopes, guide.split(1, 1), strict=True))
        inner = (..., slice(side, -side), slice(side, -side))
        self.assert_close(found[inner], guided_blur(guide, probability, side, EDGE)[inner], rtol=1e-9, atol=1e-12)

    @pytest.mark.parametrize("angle", [0, 1])
    def test_feature_classes_do_not_cross_an_edge_of_colour(self, angle):
        logits, guide = torch.zeros(1, 2, 64, 64), torch.full((1, 3, 64, 64), 0.3)
        logits[:, 0, :, :32] = logits[:, 1, :, 32:] = 4.0
        guide[:, 0, :, 32:] = 0.6  # red alone tells
        logits, guide = logits.rot90(angle, (2, 3)), guide.rot90(angle, (2, 3))
        smooth = smoothed_classes(logits, guide)
        assert torch.equal(smooth.argmax(1), logits.argmax(1))
        assert (smooth / VOTE).softmax(1).amax(1).min() > 0.85  # 0.92 before

    def test_feature_extreme_values_stay_finite(self):
        logits, guide = maps(32, 32, dtype=torch.float32)
        for scale in (0.0, 1e-6, 1e4):
            assert smoothed_classes(1e4 * logits, scale * guide).isfinite().all()

    @pytest.mark.parametrize("kind", ["colours", "grey", "black and white", "near white"])
    def test_feature_float32_agrees_with_float64(self, kind):
        """A covariance, the difference of two means up to 1, is off by some eps; EDGE is its least eigenvalue.

        Grey guides are worst: their covariance of three colours has one eigenvalue, and the edge is the others.
        """
        logits, colours = maps(64, 64)
        grey = colours[:, :1].expand(-1, 3, -1, -1)
        blocks = functional.interpolate((grey[..., :8, :8] > 0.5).double(), scale_factor=8)
        guide = {"colours": colours, "grey": grey, "black and white": blocks, "near white": 1 - 1e-3 * colours}[kind]
        single = smoothed_classes(logits.float(), guide.float())
        bound = 4 * torch.finfo(torch.float32).eps / EDGE
        self.assert_close((single / VOTE).exp(), (smoothed_classes(logits, guide) / VOTE).exp(), atol=bound, rtol=0)

    def test_gradcheck(self):
        logits, guide = maps(12, 16, classes=2)
        self.gradcheck(smoothed_classes, (logits[:1].requires_grad_(), (0.2 + 0.5 * guide[:1]).requires_grad_()))
