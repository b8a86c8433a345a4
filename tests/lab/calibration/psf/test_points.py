from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from kornia_tidy.lab.calibration.psf.points import (
    annulus_background,
    centre_of_light,
    centre_of_symmetry,
    cut_out,
    find_points,
)
from tests.base import BaseTester


def spot(row, column, size=41, width=2.0):
    x = torch.arange(float(size), dtype=torch.float64)
    return torch.exp(-((x[:, None] - row) ** 2 + (x - column) ** 2) / (2 * width**2))[None]


class TestFindPoints(BaseTester):
    def test_feature_points_are_found_brightest_first_in_noise(self):
        image = torch.zeros(1, 120, 160, dtype=torch.float64)
        for brightness, row, column in ((1.0, 30, 40), (2.0, 90, 120), (1.5, 35, 125)):
            image[:, row - 20 : row + 21, column - 20 : column + 21] += brightness * spot(20, 20)
        image += 0.05 * torch.randn(image.shape, generator=torch.Generator().manual_seed(0)).double()
        found = find_points(image[0], 3, 15)
        for (row, column), wanted in zip(found, ((90, 120), (35, 125), (30, 40)), strict=True):
            assert max(abs(row - wanted[0]), abs(column - wanted[1])) <= 1

    def test_exception_no_room(self):
        with pytest.raises(ValueError, match="no room for 9 points"):
            find_points(torch.rand(40, 40), 9, 31)
        with pytest.raises(ValueError, match="does not fit"):
            find_points(torch.rand(40, 20), 1, 31)


class TestAnnulusBackground(BaseTester):
    def test_feature_stray_points_do_not_count(self):
        generator = torch.Generator().manual_seed(0)
        image = 0.1 + 0.01 * torch.randn(2, 101, 101, generator=generator)
        image[:, 10:16, 50:56] = 0.9
        got, _ = annulus_background(image, (50, 50), 30, 45)
        self.assert_close(got[:, 30:71, 30:71], torch.full((2, 41, 41), 0.1), rtol=0, atol=2e-3)

    @given(st.floats(-1e-3, 1e-3), st.floats(-1e-3, 1e-3), st.integers(20, 80), st.integers(20, 80))
    @settings(max_examples=20)
    def test_property_a_gradient_is_found_beside_the_frame_and_under_stray_points(self, down, right, row, column):
        steps = torch.arange(101, dtype=torch.float64)
        image = (0.2 + down * steps[:, None] + right * steps)[None]
        spotted = image.clone()
        spotted[:, 90:96, 50:56], spotted[:, row - 5 : row + 5, column - 5 : column + 5] = 0.9, 0.8
        self.assert_close(annulus_background(spotted, (row, column), 30, 45)[0], image, rtol=0, atol=1e-9)

    def test_exception_nothing_of_the_ring_in_the_picture(self):
        with pytest.raises(ValueError, match="the background needs 32 pixels"):
            annulus_background(torch.zeros(1, 21, 21), (10, 10), 30, 45)


class TestCentres(BaseTester):
    @given(st.floats(17.0, 23.0), st.floats(17.0, 23.0))
    @settings(max_examples=30)
    def test_feature_both_find_a_round_spot(self, row, column):
        for centre in (centre_of_light, centre_of_symmetry):
            assert centre(spot(row, column), (20, 20), 25) == pytest.approx((row, column), abs=1e-3)

    def test_exception_no_light(self):
        with pytest.raises(ValueError, match="there is no light"):
            centre_of_light(torch.zeros(1, 21, 21), (10, 10), 11)

    def test_exception_cut_beyond_the_border(self):
        with pytest.raises(ValueError, match="leave the picture of 21x21"):
            cut_out(torch.zeros(21, 21), (3, 10), 9)
