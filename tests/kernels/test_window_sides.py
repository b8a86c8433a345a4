"""Sides of windows that are transformed: which there are, and the least that cuts an axis into as few tiles."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from kornia_tidy.kernels.window_sides import is_window_size, needed_side, size_step
from tests.base import BaseTester


def tiles(side: int, pixels: int, psf_side: int) -> int:
    return -(-pixels // (side - psf_side + 1))


SIDES = {step: [n for n in range(step, 2049, step) if is_window_size(32 * n, torch.float32)] for step in (8, 16, 32)}


class TestWindowSides(BaseTester):
    def test_cardinality_sizes_of_windows(self, dtype):
        if dtype not in (torch.float32, torch.float64):
            pytest.skip("compiled in float32 and float64")
        sizes = [n for n in range(1, 1000) if is_window_size(n, dtype)]
        assert all(n % size_step(dtype) == 0 for n in sizes)
        assert {96, 160, 288, 320, 480, 960} <= set(sizes)
        assert not {16 * 7, 32 * 11, 100, 0} & set(sizes)

    @given(st.data(), st.integers(1, 3000), st.sampled_from(sorted(SIDES)))
    def test_cardinality_needed_side(self, data, pixels, step):
        """It cuts an axis into as many tiles, and no shorter side that can be transformed does."""
        size = data.draw(st.sampled_from(SIDES[step]), "size")
        psf_side = data.draw(st.integers(1, size), "psf_side")
        needed = needed_side(size, pixels, psf_side, step)
        enough = [
            n for n in SIDES[step] if n >= psf_side and tiles(n, pixels, psf_side) <= tiles(size, pixels, psf_side)
        ]
        assert needed == min(enough)
