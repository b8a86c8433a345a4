"""Placement against its definition: each panel pixel shows the mask pixel that contains its centre."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from kornia_tidy.lab.mask_export.placement import FLIPS, ROTATIONS, PanelPlacement
from tests.base import BaseTester

SIDES = st.integers(1, 9)


def numbered(rows: int, columns: int, masks: int = 1) -> torch.Tensor:
    """Return a mask with a different number in each pixel, from 1."""
    return 1 + torch.arange(masks * rows * columns).view(masks, rows, columns)


class TestPanelPlacement(BaseTester):
    @pytest.mark.parametrize(
        ("options", "sentence"),
        [
            ({"panel": (0, 5)}, r"panel must be \(rows, columns\), both positive whole numbers, got \(0, 5\)"),
            ({"panel_pitch": 8.0}, "panel_pitch must be metres between 1e-07 and 0.001"),
            ({"pupil_radius": math.nan}, "pupil_radius must be positive and finite metres"),
            ({"offset": (0.5, 0)}, r"offset must be whole panel pixels \(right, down\), got \(0.5, 0\)"),
            ({"offset": (1, 2, 3)}, r"offset must be whole panel pixels \(right, down\), got \(1, 2, 3\)"),
            ({"panel": (5, 5, 5)}, r"panel must be \(rows, columns\), both positive whole numbers, got \(5, 5, 5\)"),
            ({"flip": "diagonal"}, "flip must be one of 'none', 'left-right', 'up-down', got 'diagonal'"),
            ({"rotate": 45}, "rotate must be one of 0, 90, 180, 270, got 45"),
        ],
    )
    def test_exception_options(self, options, sentence):
        with pytest.raises(ValueError, match=sentence):
            PanelPlacement(**options)

    def test_exception_what_does_not_fit(self):
        with pytest.raises(ValueError, match="23x23 pixels must have pixels at least as large as the panel's"):
            PanelPlacement((20, 40)).scale((23, 23))
        with pytest.raises(ValueError, match=r"a pupil_radius of at most 4.174 mm at offset \(0, 0\), got 5 mm"):
            PanelPlacement(pupil_radius=5e-3).scale((23, 23))
        PanelPlacement(pupil_radius=1200 * 8e-6 / 2.3).scale((23, 23))  # the largest radius that the message allows
        with pytest.raises(ValueError, match=r"of at most 3\.478 mm"):
            PanelPlacement(pupil_radius=4e-3, offset=(0, -100)).scale((23, 23))
        with pytest.raises(ValueError, match=r"frames must have the panel's \(1200, 1920\) pixels, got \(3, 3\)"):
            PanelPlacement().read(torch.zeros(1, 3, 3), (3, 3))

    def test_exception_a_mixed_block_is_found_wherever_it_is(self):
        placement = PanelPlacement((12, 20))
        frames = placement.place(numbered(3, 3), 0)
        for row, column in ((0, 4), (5, 9), (11, 15)):
            broken = frames.clone()
            broken[0, row, column] += 1
            with pytest.raises(ValueError, match="found a mixed block"):
                placement.read(broken, (3, 3))

    def test_cardinality(self):
        for dtype in (torch.uint8, torch.int16, torch.int64):
            frames = PanelPlacement().place(numbered(5, 5, 3).to(dtype), 7)
            assert (frames.shape, frames.dtype) == ((3, 1200, 1920), dtype)

    def test_feature_1920_by_1200_and_23_pixels_counted_by_hand(self):
        """23 blocks of 52 panel pixels are 1196: two rows remain above and below, 362 columns on either side."""
        values = numbered(23, 23, 2)
        frames = PanelPlacement().place(values, background=0)
        for k, i, j in ((0, 0, 0), (1, 11, 11), (0, 22, 3), (1, 5, 22)):
            block = frames[k, 2 + 52 * i : 54 + 52 * i, 362 + 52 * j : 414 + 52 * j]
            assert bool((block == values[k, i, j]).all())
        assert int((frames > 0).sum()) == 2 * 1196 * 1196

    @pytest.mark.parametrize(
        ("flip", "rotate", "there"),
        [  # position of mask pixel (i, j) of 5 rows and 3 columns on the panel
            ("none", 0, lambda i, j: (i, j)),
            ("none", 90, lambda i, j: (2 - j, i)),
            ("none", 180, lambda i, j: (4 - i, 2 - j)),
            ("none", 270, lambda i, j: (j, 4 - i)),
            ("left-right", 0, lambda i, j: (i, 2 - j)),
            ("left-right", 90, lambda i, j: (j, i)),
            ("up-down", 0, lambda i, j: (4 - i, j)),
            ("up-down", 90, lambda i, j: (2 - j, 4 - i)),
            ("up-down", 270, lambda i, j: (j, i)),
        ],
    )
    def test_feature_turned_and_moved_each_pixel_lies_where_it_should(self, flip, rotate, there):
        values = numbered(5, 3)
        radius = 10 * 3 * 8e-6 / 2.3  # ten panel pixels for each mask pixel
        placement = PanelPlacement((1200, 1920), 8e-6, radius, (31, -17), flip, rotate)
        frame = placement.place(values, background=0)[0]
        rows, columns = (3, 5) if rotate % 180 else (5, 3)
        top, left = 600 - 17 - 5 * rows, 960 + 31 - 5 * columns
        for i in range(5):
            for j in range(3):
                row, column = there(i, j)
                block = frame[top + 10 * row : top + 10 * row + 10, left + 10 * column : left + 10 * column + 10]
                assert bool((block == values[0, i, j]).all())
        assert int((frame > 0).sum()) == 15 * 100

    @settings(max_examples=100)
    @given(SIDES, SIDES, st.sampled_from(FLIPS), st.sampled_from(ROTATIONS), st.floats(1, 6), st.data())
    def test_feature_what_is_placed_is_read_back(self, rows, columns, flip, rotate, scale, data):
        shift = (data.draw(st.integers(-4, 4)), data.draw(st.integers(-4, 4)))
        radius = data.draw(st.sampled_from((None, scale * min(rows, columns) * 8e-6 / 2.3)))
        placement = PanelPlacement((62, 70), 8e-6, radius, shift, flip, rotate)
        values = numbered(rows, columns, 2)
        assert torch.equal(placement.read(placement.place(values, 0), (rows, columns)), values)
