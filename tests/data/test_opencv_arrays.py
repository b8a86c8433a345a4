"""Pictures to and from OpenCV's layout, against files that OpenCV wrote and read."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from kornia_tidy.arrays import image_tensor
from kornia_tidy.data import to_opencv
from tests.base import BaseTester


def from_opencv(picture):
    return image_tensor(picture[..., ::-1] if picture.ndim == 3 else picture)


class TestOpenCVArrays(BaseTester):
    @settings(max_examples=60)
    @given(
        st.sampled_from([np.uint8, np.uint16]).flatmap(
            lambda dtype: arrays.arrays(
                dtype,
                st.tuples(st.integers(1, 5), st.integers(1, 5), st.just(3))
                | st.tuples(st.integers(1, 5), st.integers(1, 5)),
            )
        )
    )
    def test_property_there_and_back_is_the_same(self, picture):
        assert np.array_equal(to_opencv(from_opencv(picture), picture.dtype), picture)

    def test_feature_red_comes_first(self):
        picture = np.array([[[10, 20, 30]]], np.uint8)
        self.assert_close(from_opencv(picture).flatten() * 255, torch.tensor([30.0, 20.0, 10.0]))

    def test_feature_values_beyond_are_clipped_and_the_image_is_left_alone(self):
        image = torch.tensor([[[-1.0, 0.5, 3.0]]], dtype=torch.float64)
        assert to_opencv(image).tolist() == [[0, 128, 255]]
        assert image.tolist() == [[[-1.0, 0.5, 3.0]]]

    def test_exception_names_what_is_wrong(self):
        with pytest.raises(TypeError, match="must be of uint8 or uint16, got int32"):
            to_opencv(torch.zeros(1, 2, 2), np.int32)
        with pytest.raises(ValueError, match=r"image must have shape .* got \(2, 2, 2\)"):
            to_opencv(torch.zeros(2, 2, 2))
        with pytest.raises(ValueError, match="image must be finite, got nan"):
            to_opencv(torch.full((1, 2, 2), torch.nan))
