"""A batch of no images gives no captures, as kornia's operators do: no error, no noise drawn, gradients of zero."""

from __future__ import annotations

import pytest
import torch

from kornia_tidy import Fidelity, LearnableDwellTimes, PixelwiseMask, TiDyOptics
from kornia_tidy.render.borders import BORDERS
from kornia_tidy.render.compositing import COMPOSITING
from tests.base import BaseTester


def camera(**options) -> TiDyOptics:
    options = {"fidelity": Fidelity(window=9, layer_spacing=5.0), **options}
    return TiDyOptics(PixelwiseMask(2), modulator=LearnableDwellTimes((1, 2)), **options)


def scenes(dtype=torch.float32, channels=3):
    return torch.rand(0, channels, 24, 32, dtype=dtype), torch.rand(0, 1, 24, 32, dtype=dtype)


class TestEmptyBatch(BaseTester):
    @pytest.mark.parametrize("border", BORDERS)
    @pytest.mark.parametrize("compositing", list(COMPOSITING))
    @pytest.mark.parametrize("channels", [3, 1])
    def test_cardinality_is_that_of_captures(self, compositing, border, channels, dtype):
        optics, state = camera(compositing=compositing, border=border), torch.get_rng_state()
        coded = optics(*scenes(dtype, channels))
        assert coded.shape == (0, channels, *((16, 24) if border == "valid" else (24, 32)))
        assert coded.dtype == dtype
        assert optics.clamped_pixels == 0
        assert torch.equal(torch.get_rng_state(), state)

    def test_feature_gradients_are_zero(self):
        optics, (image, depth) = camera(), scenes()
        optics(image.requires_grad_(), depth.requires_grad_()).sum().backward()
        for parameter in optics.parameters():
            assert float(parameter.grad.abs().max()) == 0
        assert image.grad.shape == image.shape
        assert depth.grad.shape == depth.shape

    def test_exception_a_plan_needs_a_scene(self):
        image, depth = scenes()
        with pytest.raises(ValueError, match="a plan needs at least one image and its depth, got 0 and 0"):
            camera().plan(depth, image)

    def test_exception_images_still_have_pixels(self):
        with pytest.raises(ValueError, match=r"image must hold at least one pixel, got shape \(0, 3, 0, 32\)"):
            camera()(torch.rand(0, 3, 0, 32), torch.rand(0, 1, 0, 32))
