"""What the tests of commands that take a scene share."""

from __future__ import annotations

import math

import pytest

from kornia_tidy.data import dead_leaves, write_depth, write_image


@pytest.fixture
def scene(tmp_path, monkeypatch):
    """A small dead-leaves scene on disk, in the folder in which the command runs."""
    image, depth = dead_leaves(72, 80, depth_range=(0.3, math.inf), num_leaves=200, seed=3)
    write_image(tmp_path / "image.png", image)
    write_depth(tmp_path / "depth.pfm", depth)
    monkeypatch.chdir(tmp_path)
    return tmp_path
