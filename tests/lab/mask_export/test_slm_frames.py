"""Heights to grey levels and back, accurate to half a step for every panel; and the effect on the PSFs."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from kornia_tidy import DwellTimes, Fidelity, PixelwiseMask, SpatialLightModulator, TiDyOptics
from kornia_tidy.lab.mask_export import SLMFrames
from kornia_tidy.masks import ZernikeMask
from kornia_tidy.modulator import GreyLevels
from kornia_tidy.optics import NOA61
from tests.base import BaseTester

SHARP = Fidelity(window=61, stray_light="discard", double=True)


def bank(heights: torch.Tensor, modulator=None):
    masks = PixelwiseMask(initial=heights)
    masks.phase.data = heights.double() * math.pi / 530e-9  # not rounded to float32
    with torch.no_grad():
        return TiDyOptics(masks, modulator=modulator, fidelity=SHARP).psf_bank(defocus=[-12.0, 0.0, 7.0]).psfs


class TestSLMFrames(BaseTester):
    def test_exception(self):
        with pytest.raises(TypeError, match=r"heights must be a torch.Tensor, got list"):
            SLMFrames.of([1.0], GreyLevels(8))
        with pytest.raises(ValueError, match=r"heights must have shape \(K, rows, columns\), got \(2, 2\)"):
            SLMFrames.of(torch.zeros(2, 2), GreyLevels(8))
        with pytest.raises(ValueError, match="heights must be finite metres"):
            SLMFrames.of(torch.full((1, 2, 2), math.nan), GreyLevels(8))
        with pytest.raises(ValueError, match=r"heights must be metres within 0.001 \(1 um is 1e-6\), got 530"):
            SLMFrames.of(torch.full((1, 2, 2), 530.0), GreyLevels(8))
        with pytest.raises(ValueError, match="NOA61 is published for 450 to 1550 nm, got 400 nm"):
            SLMFrames.of(torch.zeros(1, 2, 2), GreyLevels(8), 400e-9, NOA61)

    def test_feature_levels_by_hand(self):
        """At 600 nm and index 1.5 one wave is 1200 nm of height, and one level of 8 bits is 4.6875 nm."""
        heights = torch.tensor([[[0.0, 4.6875, 100.0, 1197.0, 1198.0, -5.0]]], dtype=torch.float64) * 1e-9
        frames = SLMFrames.of(heights, GreyLevels(8), wavelength=600e-9)
        assert frames.grey.tolist() == [[[0, 1, 21, 255, 0, 255]]]
        assert frames.turns.tolist() == [[[0, 0, 0, 0, 1, -1]]]
        assert frames.in_words().endswith(", 33.3% of the pixels wrapped by whole waves")
        assert (frames.bits, frames.background) == (8, 0)

    @settings(max_examples=80)
    @given(
        st.integers(1, 10),
        st.floats(0.5, 4 * math.pi),
        st.none() | st.tuples(st.floats(0, 4), st.floats(3.01, 8.5), st.floats(0.4, 2.5)),
        st.floats(400e-9, 1600e-9),
        st.integers(0, 2**32),
    )
    def test_feature_heights_come_back_within_the_bound_and_no_level_is_nearer(self, bits, span, response, wave, seed):
        heights = torch.from_numpy(np.random.default_rng(seed).uniform(-3e-6, 5e-6, (2, 4, 3)))
        if response is not None:
            low, high, power = response
            response = low + high * np.linspace(0, 1, 2**bits) ** power
        frames = SLMFrames.of(heights, GreyLevels(bits, span, response), wave)
        error = (frames.heights() - heights).abs() * frames.radians_per_metre
        assert float(error.max()) <= frames.largest_error() + 1e-9
        wanted = (2 * math.pi * 0.5 / wave * heights).numpy()[..., None]
        apart = np.abs(np.angle(np.exp(1j * (wanted - frames.level_phases.numpy())))).min(-1)
        np.testing.assert_allclose(error.numpy(), apart, rtol=0, atol=1e-9)

    @pytest.mark.parametrize(("bits", "span"), [(8, 2 * math.pi), (10, 2 * math.pi), (5, math.pi), (8, 3 * math.pi)])
    def test_feature_the_bound_is_reached(self, bits, span):
        heights = torch.linspace(0, 1.06e-6, 20001, dtype=torch.float64).view(1, 1, -1)
        frames = SLMFrames.of(heights, GreyLevels(bits, span))
        worst = float((frames.heights() - heights).abs().max()) * frames.radians_per_metre
        assert 0.95 * frames.largest_error() < worst <= frames.largest_error() + 1e-9

    def test_feature_heights_shown_are_those_that_the_simulated_panel_shows(self):
        heights = 2.4e-6 * torch.rand(2, 23, 23, dtype=torch.float64)
        frames = SLMFrames.of(heights, GreyLevels(6))
        panel = SpatialLightModulator(GreyLevels(6), DwellTimes())
        self.assert_close(bank(frames.heights_shown()), bank(heights, panel), rtol=0, atol=1e-12)
        self.assert_close(bank(frames.heights_shown())[:, 1], bank(frames.heights())[:, 1], rtol=0, atol=1e-12)
        assert float((bank(frames.heights_shown()) - bank(frames.heights()))[:, 2].abs().sum((-2, -1)).max()) > 0.1

    def test_feature_masks_of_any_family_with_their_limits_and_material(self):
        masks = ZernikeMask(3, material=NOA61, constraint="clamp", max_height=8e-7)
        frames = SLMFrames.of(masks, GreyLevels(10), wavelength=633e-9)
        error = (frames.heights() - masks.heights().detach()).abs().max()
        assert float(error) <= 633e-9 / (NOA61.index(633e-9) - 1) / 2**11 * 1.001 + 1e-13
        assert float(frames.heights().max()) < 8.01e-7
