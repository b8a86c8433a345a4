"""Bilateral filter, against kornia's where widths are the same everywhere."""

from __future__ import annotations

import pytest
import torch
from kornia.filters import bilateral_blur

from kornia_tidy.reconstruction.bilateral import bilateral_filter
from tests.base import BaseTester


def noise(*shape, dtype=torch.float64):
    return torch.rand(*shape, dtype=dtype, generator=torch.Generator().manual_seed(0))


class TestBilateralFilter(BaseTester):
    def test_exception(self):
        with pytest.raises(ValueError, match="window must be odd and positive, got 4"):
            bilateral_filter(noise(1, 3, 8, 8), 0.2, window=4)
        with pytest.raises(ValueError, match="image"):
            bilateral_filter(noise(3, 8, 8), 0.2)

    @pytest.mark.parametrize(("window", "color", "space"), [(7, 0.2, 2.0), (5, 0.5, 1.0), (1, 0.1, 1.0)])
    def test_feature_equals_kornia(self, window, color, space):
        image = noise(2, 3, 12, 13)
        expected = bilateral_blur(image, window, color, (space, space), "reflect")
        self.assert_close(bilateral_filter(image, color, window, space), expected, atol=1e-6, rtol=0)

    def test_feature_pixels_have_widths_of_their_own(self):
        image = noise(1, 3, 10, 16)
        widths = torch.full((1, 1, 1, 16), 0.1, dtype=image.dtype)
        widths[..., 8:] = 0.6
        found = bilateral_filter(image, widths)
        self.assert_close(found[..., :8], bilateral_filter(image, 0.1)[..., :8])
        self.assert_close(found[..., 8:], bilateral_filter(image, 0.6)[..., 8:])

    @pytest.mark.parametrize("height", [65, 130])
    def test_feature_strips_without_gradients_and_several_widths_are_the_whole(self, height):
        image, colors = torch.rand(2, 3, height, 9, dtype=torch.float64), torch.rand(4, 2, 1, 1, 1) + 0.05
        with torch.no_grad():
            found = bilateral_filter(image, colors)
        self.assert_close(found, torch.stack([bilateral_filter(image, c) for c in colors]), atol=1e-12, rtol=0)

    def test_gradcheck(self, device):
        widths = torch.full((1, 1, 1, 1), 0.3, dtype=torch.float64, requires_grad=True)
        image = noise(1, 2, 4, 5).requires_grad_()
        self.gradcheck(lambda *inputs: bilateral_filter(*inputs, window=3), (image, widths))
