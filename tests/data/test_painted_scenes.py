"""What every painter of scenes keeps to: shapes, seeds, ranges of image and depth, and errors."""

from __future__ import annotations

from functools import partial

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from kornia_tidy.data import (
    DeadLeaves,
    PhotoCollages,
    PhotographicLeaves,
    dead_leaves,
    photo_collage,
    photographic_leaves,
    photographs_in,
)
from tests.base import BaseTester

KINDS = ("dead leaves", "photographic leaves", "photo collages")
every_painter = pytest.mark.parametrize("kind", KINDS)


@pytest.fixture(scope="module")
def painters(tmp_path_factory):
    """The function and the data set of each kind."""
    folder = tmp_path_factory.mktemp("photographs")
    for number in range(3):
        pixels = np.random.default_rng(number).integers(0, 256, (50, 60, 3), np.uint8)
        assert cv2.imwrite(str(folder / f"{number}.png"), pixels)
    pairs = (
        (partial(dead_leaves, num_leaves=60), partial(DeadLeaves, num_leaves=60)),
        (photographic_leaves, PhotographicLeaves),
        tuple(partial(one, photographs_in(folder)) for one in (photo_collage, PhotoCollages)),
    )
    return dict(zip(KINDS, pairs, strict=True))


@every_painter
class TestEveryPainter(BaseTester):
    @pytest.mark.parametrize(("height", "width"), [(1, 1), (1, 50), (7, 3), (33, 64), (130, 20)])
    def test_cardinality(self, painters, kind, height, width):
        image, depth = painters[kind][0](height, width)
        assert (image.shape, depth.shape) == ((3, height, width), (1, height, width))
        assert image.dtype == depth.dtype == torch.float32
        assert image.is_contiguous()

    def test_feature_the_seed_alone_decides_and_global_states_are_left_alone(self, painters, kind):
        paint, threads, cv_threads = painters[kind][0], torch.get_num_threads(), cv2.getNumThreads()
        first = paint(48, 40, seed=5)
        try:
            torch.set_num_threads(2)
            cv2.setNumThreads(2)
            np.random.seed(123)  # noqa: NPY002 - the legacy global state is what must not matter
            torch.manual_seed(123)
            state, legacy = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
            second, other = paint(48, 40, seed=5), paint(48, 40, seed=6)
        finally:
            torch.set_num_threads(threads)
            cv2.setNumThreads(cv_threads)
        assert torch.equal(torch.get_rng_state(), state)
        assert np.array_equal(np.random.get_state()[1], legacy)  # noqa: NPY002
        assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))
        assert (first[0] != other[0]).float().mean() > 0.9
        assert (first[1] != other[1]).float().mean() > 0.3

    def test_feature_seeds_and_indices_give_unrelated_scenes(self, painters, kind):
        sets = [painters[kind][1](3, 16, 16, seed=seed) for seed in range(3)]
        assert len(torch.stack([scene["image"] for scenes in sets for scene in scenes]).unique(dim=0)) == 9

    @settings(max_examples=10)
    @given(
        st.tuples(st.integers(1, 24), st.integers(1, 24)), st.integers(0, 2**64), st.floats(0.01, 10),
        st.floats(1.01, 1e6),
    )  # fmt: skip
    def test_property_values_stay_within_their_ranges(self, painters, kind, size, seed, near, ratio):
        image, depth = painters[kind][0](*size, depth_range=(near, near * ratio), seed=seed)
        assert bool(((image >= 0) & (image <= 1)).all())
        assert bool(((depth >= np.float32(near)) & (depth <= np.float32(near * ratio))).all())

    @pytest.mark.parametrize(
        ("changed", "message"),
        [
            ({"height": 0}, "height must be a whole number of at least 1, got 0"),
            ({"width": 2.5}, "width must be a whole number of at least 1, got 2.5"),
            ({"seed": -1}, "seed must be a whole number of at least 0, got -1"),
            ({"depth_range": (0.0, 1.0)}, r"0 < near < far, got \(0.0, 1.0\)"),
            ({"depth_range": (2.0, 1.0)}, r"0 < near < far, got \(2.0, 1.0\)"),
            ({"depth_range": (float("nan"), 1.0)}, "0 < near < far"),
            ({"depth_range": (float("inf"), float("inf"))}, "0 < near < far"),
            ({"length": 0}, "length must be a whole number of at least 1, got 0"),
        ],
    )
    def test_exception_names_the_bad_value_before_any_item_is_asked_for(self, painters, kind, changed, message):
        paint, scenes = painters[kind]
        with pytest.raises(ValueError, match=message):
            scenes(**{"length": 2, "height": 8, "width": 8, **changed})
        if "length" not in changed:
            with pytest.raises(ValueError, match=message):
                paint(**{"height": 8, "width": 8, **changed})


def test_exception_what_one_kind_alone_takes():
    with pytest.raises(ValueError, match="num_leaves must be a whole number of at least 1, got -3"):
        dead_leaves(8, 8, num_leaves=-3)
    for call in (partial(photo_collage, [], 8, 8), partial(PhotoCollages, [], 2, 8, 8)):
        with pytest.raises(ValueError, match="photographs must hold one path or more, got none"):
            call()


def test_feature_sky_is_known():
    sample = DeadLeaves(1, 64, 64, num_leaves=60, depth_range=(0.5, float("inf")))[0]
    assert sample["depth"].isinf().any()
    assert sample["mask"].all()
