"""The scenes that come with the library."""

from __future__ import annotations

import math

import pytest
import torch

from kornia_tidy.data import sample_scene
from kornia_tidy.data.sample_scenes import SCENES
from tests.base import BaseTester

TABLE, WALL, EDGE = 0.24, 3.2, 1.75  # m: below the eye, ahead of it, and where the table ends
PITCH, FOCAL_LENGTH = math.radians(14), 1.1 * 640  # the view looks down; pixels


@pytest.fixture(scope="module")
def scene():
    return sample_scene()


class TestSampleScene(BaseTester):
    @pytest.mark.parametrize("name", SCENES)
    def test_feature_is_the_same_at_each_call_and_a_whole_scene(self, name):
        image, depth, valid = sample_scene(name)
        assert bool(valid.all())
        assert (image.shape, depth.shape) == ((3, 480, 640), (1, 480, 640))
        assert 0 <= float(image.min()) < 0.1
        assert 0.9 < float(image.max()) <= 1
        assert float(depth.max()) > 3 * float(depth.min()) > 0.9  # m
        assert torch.equal(sample_scene(name, height=48)[0], sample_scene(name, height=48)[0])

    def test_feature_depths_of_the_table_lie_on_a_plane_and_those_of_the_wall_on_another(self, scene):
        """In the directions of the pixels: y = TABLE up to z = EDGE, and z = WALL; things stand before both."""
        depth = scene[1][0].double()
        down = ((torch.arange(480.0, dtype=torch.float64) - 239.5) / FOCAL_LENGTH)[:, None]
        y = depth * (down * math.cos(PITCH) + math.sin(PITCH))
        z = depth * (math.cos(PITCH) - down * math.sin(PITCH))
        wall = (z - WALL).abs() < 0.01
        table = ~wall & ((y - TABLE).abs() < 0.003)
        assert float(wall.float().mean()) > 0.15
        assert float(table.float().mean()) > 0.3
        assert float(z[table].max()) < EDGE + 0.03
        assert bool((z[~wall & ~table] < EDGE).float().mean() > 0.97)

    def test_feature_shadows_fall_away_from_the_light(self, scene):
        """The table is darker at the right of the ball in front, where its shadow is, than at its left."""
        image = scene[0]
        left, right = (image[:, 415:435, columns].mean() for columns in (slice(100, 130), slice(285, 315)))
        assert float(right) < 0.8 * float(left)

    @pytest.mark.parametrize("height", [0, 2.5])
    def test_exception_height(self, height):
        with pytest.raises(ValueError, match=f"height must be a whole number of at least 1, got {height}"):
            sample_scene(height=height)

    def test_exception_unknown_name(self):
        with pytest.raises(ValueError, match=r"name of a sample scene must be one of .*, got 'desk'"):
            sample_scene("desk")
