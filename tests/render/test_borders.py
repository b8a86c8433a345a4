from __future__ import annotations

import cv2
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.fft import next_fast_len

from kornia_tidy.render.borders import BORDERS, check_border, extended, next_fast_size, pad_border
from tests.base import BaseTester


class TestNextFastSize(BaseTester):
    def test_feature_equals_scipy(self):
        sizes = range(1, 3000)
        assert [next_fast_size(n) for n in sizes] == [next_fast_len(n, real=True) for n in sizes]


class TestPadBorder(BaseTester):
    @pytest.mark.parametrize(
        ("border", "code"),
        [
            ("reflect", cv2.BORDER_REFLECT_101),
            ("replicate", cv2.BORDER_REPLICATE),
            ("zero", cv2.BORDER_CONSTANT),
            ("circular", cv2.BORDER_WRAP),
        ],
    )
    def test_convention_borders_are_those_of_opencv(self, border, code, device, dtype):
        image = torch.rand(1, 1, 5, 7, device=device, dtype=dtype)
        expected = cv2.copyMakeBorder(image[0, 0].double().cpu().numpy(), 4, 4, 4, 4, code)
        padded = pad_border(image, 4, border)
        assert torch.equal(padded[0, 0].double().cpu(), torch.from_numpy(expected))

    @given(data=st.data())
    @settings(max_examples=100)
    def test_property_rows_of_the_extended_image_are_those_of_the_padded_one(self, data):
        radius, border = data.draw(st.integers(0, 4)), data.draw(st.sampled_from(BORDERS[:-1]))
        height, width = (data.draw(st.integers(2 * radius + 1, 20)) for _ in range(2))
        image = torch.rand(2, 3, height, width)
        whole = pad_border(image, radius, border)
        top = data.draw(st.integers(0, height - 1))
        bottom = data.draw(st.integers(top + 1, height))
        band = extended(image, (top - radius, bottom + radius), (-radius, width + radius), border)
        assert torch.equal(band, whole[..., top : bottom + 2 * radius, :])

    def test_feature_valid_makes_nothing_up(self, device, dtype):
        image = torch.rand(1, 1, 5, 7, device=device, dtype=dtype)
        assert pad_border(image, 2, "valid") is image


class TestCheckBorder(BaseTester):
    def test_exception_unknown_border(self):
        with pytest.raises(ValueError, match=r"border must be one of 'reflect', .*'valid', got 'mirror'"):
            check_border("mirror", 9, 9, 3)

    @pytest.mark.parametrize(
        ("border", "needs", "working"),
        [
            ("reflect", 5, "'replicate', 'zero'"),
            ("circular", 4, "'replicate', 'zero'"),
            ("valid", 9, "'replicate', 'zero'"),
        ],
    )
    def test_exception_names_the_sizes_and_the_borders_that_work(self, border, needs, working):
        message = f"border '{border}' needs an image of at least {needs} pixels a side for PSFs of 9x9, got 30x3; "
        with pytest.raises(ValueError, match=message + f"borders that work here: {working}$"):
            check_border(border, 30, 3, 9)

    @pytest.mark.parametrize("border", BORDERS)
    @pytest.mark.parametrize("psf_size", [1, 3, 9])
    def test_feature_accepts_exactly_the_sizes_that_torch_can_pad(self, border, psf_size):
        """The oracle is torch's own padding, and for ``valid`` a convolution without padding."""
        for side in range(1, 12):
            image = torch.rand(1, 1, side, side)
            try:
                torch.nn.functional.conv2d(
                    pad_border(image, psf_size // 2, border), torch.rand(1, 1, psf_size, psf_size)
                )
                possible = True
            except RuntimeError:
                possible = False
            try:
                check_border(border, side, side, psf_size)
                accepted = True
            except ValueError:
                accepted = False
            assert accepted == possible, side
