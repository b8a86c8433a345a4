from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from kornia_tidy.accuracy.depth_energy import LEVELS, Depths, octave_filters
from tests.base import BaseTester
from tests.rounding import gamma


class TestOctaves(BaseTester):
    @pytest.mark.parametrize("size", [16, 27, 90])
    def test_property_filters_share_out_all_power(self, size):
        filters = octave_filters(size)
        assert float(filters.min()) >= -1e-15
        self.assert_close(filters.sum(0), torch.ones(size, size // 2 + 1).double(), atol=1e-14, rtol=0)

    def test_feature_filters_are_what_cells_lose_on_average(self):
        """Power between averages over 2 and 4 px, over all places where cells may begin, of an endless image."""
        image = torch.rand(64, 64, dtype=torch.float64)
        lost = []
        for down in range(4):
            for across in range(4):
                cells = image.roll((down, across), (0, 1)).unflatten(0, (-1, 2)).unflatten(2, (-1, 2)).mean((1, 3))
                coarser = cells.unflatten(0, (-1, 2)).unflatten(2, (-1, 2)).mean((1, 3))
                lost.append(cells.square().mean() - coarser.square().mean())
        half = torch.fft.rfft2(image).abs().square() / 64**4
        half[:, 1:-1] *= 2
        self.assert_close((half * octave_filters(64)[1]).sum(), torch.stack(lost).mean(), atol=1e-14, rtol=0)


class TestDepths(BaseTester):
    def test_feature_isolated_depths_are_kept_exactly(self):
        depths = Depths(torch.tensor([[[[0.1, 0.1], [7.3, torch.inf]]]]), -20, 20, "reflect")
        self.assert_close(depths.psi, torch.tensor([0.1, 7.3, 20.0]), atol=1e-6, rtol=0)
        assert depths.share.tolist() == [0.5, 0.25, 0.25]

    @pytest.mark.parametrize("border", ["reflect", "replicate", "zero", "circular", "valid"])
    @settings(max_examples=5)
    @given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 2**31))
    def test_property_products_add_up_to_the_power_of_the_image(self, border, height, width, seed):
        """Less that of the means: of octave after octave nothing is lost. Mirrored at the borders, it counts again."""
        generator = torch.Generator().manual_seed(seed)
        light = torch.rand(2, 1, height, width, generator=generator)
        some = (torch.rand(2, 1, height, width, generator=generator) * 4).floor()
        products = Depths(some, -20, 20, border).products(light)
        whole = Depths(torch.zeros_like(some), -20, 20, border)
        # Sums over cells in float32, squared, for each octave; streaks of the border count on top of the image.
        laid_out = len(whole._rows) * len(whole._columns) / (height * width) if border == "replicate" else 1.0
        round_off = 2 * (LEVELS + 1) * gamma(4**LEVELS, torch.float32) * laid_out
        together = whole.products(light)[..., 0, 0]
        self.assert_close(products.sum((-2, -1)), together, atol=round_off, rtol=0)
        assert float(torch.linalg.eigvalsh(products.sum(1)).min()) > -round_off

    def test_feature_large_images_are_taken_in_strips(self, monkeypatch):
        light, defocus = torch.rand(2, 1, 90, 70), torch.rand(2, 1, 90, 70)
        whole = Depths(defocus, -20, 20, "reflect").products(light)
        monkeypatch.setattr("kornia_tidy.accuracy.depth_energy._STRIP", 64)
        self.assert_close(Depths(defocus, -20, 20, "reflect").products(light), whole, atol=1e-9, rtol=1e-5)

    def test_feature_shares_lie_where_the_light_is(self):
        """A texture at one depth in the dark of another: its power counts for both depths, and not for a third."""
        light, defocus = torch.zeros(1, 1, 256, 256), torch.zeros(1, 1, 256, 256)
        light[..., 30:60, 30:60] = torch.rand(30, 30)
        defocus[..., 30:60, 30:60] = 5
        defocus[..., 200:, 200:] = -5
        far, dark, textured = Depths(defocus, -20, 20, "reflect").shares(light)[0, :LEVELS].unbind(-1)
        assert float(textured[:3].min()) > 0.5
        assert float(dark[:3].min()) > 0.1
        assert float(far[:3].max()) < 1e-2  # what differs from the mean, everywhere a little

    def test_feature_texture_and_depth_apart_share_by_area(self):
        light = torch.rand(1, 1, 128, 128)
        defocus = torch.zeros(1, 1, 128, 128)
        defocus[..., 96:] = 3
        shares = Depths(defocus, -20, 20, "circular").shares(light)[0, 0]
        self.assert_close(shares, torch.tensor([0.75, 0.25]), atol=0.06, rtol=0)

    def test_feature_what_a_capture_does_not_show_does_not_count(self):
        light, defocus = torch.zeros(1, 1, 96, 96), torch.zeros(1, 1, 96, 96)
        light[..., :8, :] = torch.rand(8, 96)
        defocus[..., :8, :] = 4
        depths = Depths(defocus, -20, 20, "valid", margin=16)
        assert depths.seen == pytest.approx((64 / 96) ** 2)
        assert float(depths.shares(light)[0, 0, 1]) == 0
