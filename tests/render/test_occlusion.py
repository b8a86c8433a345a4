"""The physics of occlusion; its comparisons with models and between backends are those of all compositing."""

from __future__ import annotations

from itertools import product

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from kornia_tidy.render import layer_weights, render
from kornia_tidy.render.backends.dense_occlusion import EPSILON, cumulative_weight, lay_over
from kornia_tidy.render.borders import BORDERS
from tests.base import BaseTester
from tests.render.render_tester import METHODS
from tests.render.scenes import Bank, hard_depth, make_bank, make_scene, squares


class TestOcclusion(BaseTester):
    def test_feature_cumulative_weight_adds_up_the_layers(self, device):
        bank = make_bank(6, device=device)
        _, defocus = make_scene(bank)
        lower = torch.bucketize(defocus.clamp(-20, 20), bank.defocus[1:-1])
        fraction = (defocus.clamp(-20, 20) - bank.defocus[lower]) / bank.defocus.diff()[lower]
        weights = layer_weights(defocus, bank.defocus, "linear")
        for index in range(6):
            expected = weights[:, : index + 1].sum(1, keepdim=True)
            self.assert_close(cumulative_weight(lower, fraction, index), expected, rtol=0, atol=1e-14)
            assert torch.equal(cumulative_weight(lower, None, index), lower <= index)

    def test_feature_a_negative_divisor_counts_as_none(self, device, dtype):
        """Interpolated PSFs can be negative in places."""
        light, seen = torch.tensor(1e-7, device=device, dtype=dtype), torch.tensor(-5.0, device=device, dtype=dtype)
        self.assert_close(lay_over([(light, light, seen)]), light / EPSILON, rtol=1e-6, atol=0)

    # Physics

    @pytest.mark.parametrize("method", METHODS)
    @pytest.mark.parametrize("layers", ["nearest", "linear"])
    @pytest.mark.parametrize("border", BORDERS)
    def test_property_white_stays_white(self, method, layers, border, device, dtype):
        """To epsilon over the smallest share of a PSF by which a layer is seen; here a pixel of a 5 x 5 PSF or more."""
        psfs = make_bank(6, 3, 5, dtype=dtype, device=device).psfs + 0.04
        bank = Bank(psfs / psfs.sum((-2, -1), keepdim=True), make_bank(6, device=device, dtype=dtype).defocus)
        image, defocus = make_scene(bank, 2, 24, 17)
        options = {"layers": layers, "border": border, "method": method}
        white = render(torch.ones_like(image), squares(bank, 24, 17), bank, "occlusion", **options)
        assert float(bank.psfs.min()) > 0.015
        self.assert_close(white, torch.ones_like(white), rtol=0, atol=EPSILON / 0.015)
        speckled = render(torch.ones_like(image), defocus, bank, "occlusion", border=border, method=method)
        assert float((speckled - 1).abs().max()) < 1e-3  # a pixel's own layer may have a weight of near to nothing

    @given(seed=st.integers(0, 99), border=st.sampled_from(BORDERS), layers=st.sampled_from(["nearest", "linear"]))
    @settings(max_examples=25)
    def test_property_light_is_never_negative_nor_beyond_the_brightest(self, seed, border, layers):
        torch.manual_seed(seed)
        bank = make_bank(5, 1, 5)
        image, defocus = make_scene(bank, 1, 20, 33)
        coded = render(image, defocus, bank, "occlusion", border=border, layers=layers)
        assert float(coded.min()) > -1e-9
        assert float(coded.max()) < 1 + 1e-9

    def test_feature_float32_is_float64_where_divisors_vanish(self, device):
        """PSFs with tails of 1e-9, by which layers are hardly seen: round-off of float32 would show as 1e-2."""
        psfs = torch.rand(6, 1, 15, 15, device=device, dtype=torch.float64) ** 12
        bank = Bank(psfs / psfs.sum((-2, -1), keepdim=True), make_bank(6, device=device).defocus)
        image, _ = make_scene(bank, 1, 70, 80)
        single = Bank(bank.psfs.float(), bank.defocus.float())
        for kind, layers in product(("squares", "steep ramp", "speck"), ("nearest", "linear")):
            defocus = hard_depth(kind, bank, 70, 80).float()
            expected = render(image, defocus.double(), bank, "occlusion", layers=layers, method="dense")
            for method in METHODS:
                coded = render(image.float(), defocus, single, "occlusion", layers=layers, method=method)
                self.assert_close(coded.double(), expected, rtol=0, atol=2e-5)
