"""A camera that takes large pictures within its memory, strip by strip."""

from __future__ import annotations

import pytest
import torch

from kornia_tidy import Fidelity, PixelwiseMask, SensorNoise, TiDyOptics
from kornia_tidy.camera.samples import read_sample
from kornia_tidy.design.tradeoff.costs import peak_bytes
from kornia_tidy.render.borders import BORDERS
from tests.base import BaseTester


def make_optics(**options) -> TiDyOptics:
    torch.manual_seed(3)
    return TiDyOptics(PixelwiseMask(2), fidelity=Fidelity(window=11, layer_spacing=5.0), **options)


def make_scene(height: int, width: int, dtype=torch.float32):
    image = torch.rand(1, 3, height, width, dtype=dtype)
    depth = torch.nn.functional.interpolate(torch.rand(1, 1, 9, 9, dtype=dtype) + 0.4, (height, width), mode="bilinear")
    return image, depth


class TestCaptureInBands(BaseTester):
    @pytest.mark.parametrize("border", BORDERS)
    @pytest.mark.parametrize("compositing", ["gather", "scatter", "occlusion"])
    @torch.no_grad()
    def test_feature_is_the_capture_at_once(self, border, compositing):
        optics = make_optics(border=border, compositing=compositing, sensor=SensorNoise(0.02, full_well=5000.0))
        image, depth = make_scene(301, 67, torch.float64)
        expected = optics(image, depth, generator=torch.Generator().manual_seed(5))
        clamped = optics.clamped_pixels
        optics.memory_budget = 1
        rows = next(optics.strips(read_sample(image, depth, optics))).rows
        assert rows == (None if (compositing, border) == ("occlusion", "zero") else slice(0, 64))
        coded = optics(image, depth, generator=torch.Generator().manual_seed(5))
        self.assert_close(coded, expected, rtol=0, atol=1e-11)
        assert optics.clamped_pixels == clamped

    @pytest.mark.parametrize("border", BORDERS)
    @torch.no_grad()
    def test_feature_stray_light_is_spread_over_the_whole_image(self, border):
        """Which a band does not know: it goes at once, whatever the budget."""
        optics = make_optics(border=border, sensor=None)
        optics = optics.with_fidelity(optics.fidelity.replace(stray_light="veil"))
        image, depth = make_scene(200, 40, torch.float64)
        expected = optics(image, depth)
        optics.memory_budget = 1
        assert torch.equal(optics(image, depth), expected)

    @torch.no_grad()
    def test_feature_half_of_the_budget_is_for_the_picture(self):
        optics = make_optics()
        sample = read_sample(*make_scene(1000, 300), optics)
        for budget, rows in ((2 * sample.bytes_at_once, None), (64 << 20, slice(0, 192))):
            optics.memory_budget = budget
            assert next(optics.strips(sample)).rows == rows

    @pytest.mark.takes_seconds
    @torch.no_grad()
    def test_feature_peak_memory_is_within_the_budget(self):
        optics = make_optics(memory_budget=64 << 20)
        image, depth = make_scene(3000, 700)
        optics(image, depth)
        taken = peak_bytes(lambda: optics(image, depth), image.device)
        assert taken - 4 * image.numel() <= 64 << 20
        optics.memory_budget = 1 << 40
        assert peak_bytes(lambda: optics(image, depth), image.device) > 1.5 * (64 << 20)

    def test_feature_numbers_of_twice_as_many_bytes_take_twice_the_memory(self):
        one, two = (read_sample(*make_scene(64, 64, t), make_optics()) for t in (torch.float32, torch.float64))
        empty = read_sample(*(x[:0] for x in make_scene(64, 64)), make_optics()).bytes_at_once
        assert two.bytes_at_once - empty == 2 * (one.bytes_at_once - empty) > 0

    def test_feature_gradients_take_the_image_at_once(self):
        optics = make_optics(memory_budget=1)
        image, depth = make_scene(150, 40)
        assert next(optics.strips(read_sample(image, depth, optics))).rows is None
        optics(image, depth).sum().backward()
        assert optics.masks.phase.grad.abs().sum() > 0

    def test_exception_a_wrong_depth_in_the_last_band(self):
        optics = make_optics(memory_budget=1)
        image, depth = make_scene(150, 40)
        depth[..., -1, -1] = -2.0
        with torch.no_grad(), pytest.raises(ValueError, match=r"depth must be positive metres, got -2\.0"):
            optics(image, depth)

    def test_exception_the_budget(self):
        with pytest.raises(ValueError, match="memory_budget must be positive and finite bytes, got 0"):
            make_optics(memory_budget=0)
