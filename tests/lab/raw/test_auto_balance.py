"""White balance from what a capture shows: exact where the scene is grey, near neutral on real pictures without one."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from kornia_tidy.lab.raw import RawCapture
from kornia_tidy.lab.raw.auto_balance import auto_balance
from kornia_tidy.lab.raw.filter_array import filter_tile, tiled
from tests.base import BaseTester
from tests.lab.raw.dng import XTRANS


def grey_under(light, letters="RGGB", white=60000, size=48):
    """A grey scene in a light, given by the letters of the colours; a grey value a tile, so that none is between."""
    tile, colors = filter_tile(letters) if letters else (None, "RGB")
    side = 1 if tile is None else len(tile)
    generator = torch.Generator().manual_seed(0)
    grey = (0.05 + 0.4 * torch.rand(size // side, size // side, generator=generator)).double()
    grey = grey.repeat_interleave(side, 0).repeat_interleave(side, 1)
    if tile is None:
        counts = torch.stack([light[letter] * grey for letter in colors])
    else:
        seen = torch.tensor([light[letter] for letter in colors], dtype=torch.float64)
        counts = (tiled(seen[torch.tensor(tile)], size, size) * grey)[None]
    return RawCapture.from_counts((100 + (white - 100) * counts).round(), letters, 100, white)


class TestAutoBalance(BaseTester):
    @pytest.mark.parametrize("letters", ["RGGB", "GBRG", XTRANS, None])
    @given(red=st.floats(0.3, 1.5), blue=st.floats(0.3, 1.5))
    @settings(max_examples=15)
    def test_feature_a_grey_scene_becomes_grey_in_any_light(self, letters, red, blue):
        """To the rounding of counts: half of one, of 60000 * 0.05 * 0.3 at least."""
        raw = grey_under({"R": red, "G": 1.0, "B": blue}, letters)
        wanted = {"R": 1 / red, "G": 1.0, "B": 1 / blue}
        factors = auto_balance(raw)
        self.assert_close(factors, torch.tensor([wanted[letter] for letter in raw.colors]), rtol=2 * 0.5 / 900, atol=0)

    def test_feature_of_four_colours(self):
        raw = grey_under({"G": 1.0, "M": 0.8, "C": 0.5, "Y": 1.6}, "GMYC")
        self.assert_close(auto_balance(raw), torch.tensor([1.0, 1.25, 2.0, 0.625]), rtol=1e-3, atol=0)

    def test_feature_what_is_saturated_tells_nothing(self):
        raw = grey_under({"R": 0.5, "G": 1.0, "B": 0.8})
        blown = raw.counts.clone()
        blown[:, :20] = 60000
        self.assert_close(
            auto_balance(replace(raw, counts=blown))[[0, 1, 2]], torch.tensor([2.0, 1.0, 1.25]), rtol=2e-3
        )

    def test_feature_large_captures_are_subsampled(self):
        raw = grey_under({"R": 0.5, "G": 1.0, "B": 0.8}, size=3000)
        self.assert_close(auto_balance(raw)[[0, 1, 2]], torch.tensor([2.0, 1.0, 1.25]), rtol=2e-3, atol=0)

    @pytest.mark.parametrize(
        ("level", "reason"), [(60000, "is saturated everywhere, so its white"), (100, "a channel of the capture")]
    )
    def test_exception_balance_cannot_be_estimated(self, level, reason):
        raw = grey_under({"R": 0.5, "G": 1.0, "B": 0.8})
        with pytest.raises(ValueError, match=reason):
            auto_balance(replace(raw, counts=torch.full_like(raw.counts, level)))
