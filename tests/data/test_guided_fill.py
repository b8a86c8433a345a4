"""Filling of sparse depth: known pixels are kept, steps of depth follow the image, and real scenes gain by it."""

from __future__ import annotations

import numpy as np
import torch

from kornia_tidy.data import fill_holes
from kornia_tidy.data.guided_fill import fill_guided
from tests.base import BaseTester


def sparse(shape, seed=0):
    """Every sixth row, a third of its pixels, about as a laser scanner sees them."""
    rng = np.random.default_rng(seed)
    known = np.zeros(shape, bool)
    known[3::6] = rng.random(known[3::6].shape) < 0.35
    return known


class TestFillGuided(BaseTester):
    def test_feature_an_oblique_step_follows_the_image(self):
        rows, columns = np.indices((60, 80))
        near = columns > 20 + rows / 2
        depth = np.where(near, 1.0, 4.0).astype(np.float32)
        image = torch.from_numpy(np.where(near, 0.9, 0.1)).float()[None]
        known = sparse(depth.shape)
        wrong = np.abs(fill_guided(np.where(known, depth, 9).astype(np.float32), known, image) / depth - 1) > 0.05
        slabs = np.abs(fill_holes(np.where(known, depth, 0))[0] / depth - 1) > 0.05
        assert wrong.mean() < 0.002
        assert slabs.mean() > 5 * wrong.mean()
        assert slabs.mean() > 0.01

    def test_feature_a_slanted_plane_is_better_than_slabs(self):
        _, columns = np.indices((60, 80))
        depth = (1 / (0.2 + columns / 80)).astype(np.float32)  # a plane: inverse depth is linear
        known = sparse(depth.shape)
        errors = [
            np.abs(1 / fill - 1 / depth).mean()
            for fill in (fill_guided(depth, known, torch.zeros(3, 60, 80)), fill_holes(np.where(known, depth, 0))[0])
        ]
        assert errors[0] < errors[1]

    def test_feature_known_pixels_and_infinity_are_kept(self):
        depth, known = np.full((30, 40), np.inf, np.float32), sparse((30, 40))
        image = torch.zeros(1, 30, 40)
        assert np.isinf(fill_guided(depth, known, image)).all()
        depth[:, 20:], image[..., 20:] = 2.0, 1.0
        found = fill_guided(depth, known, image)
        assert (found[known] == depth[known]).all()
        assert np.isinf(found[:, :20]).all()
        assert np.allclose(found[:, 20:], 2, rtol=1e-3)

    def test_feature_out_of_reach_is_the_nearest_and_nothing_is_left(self):
        depth, known = np.zeros((400, 20), np.float32), np.zeros((400, 20), bool)
        depth[399], known[399] = 3.0, True
        image = torch.rand(3, 400, 20, generator=torch.Generator().manual_seed(0))
        assert np.allclose(fill_guided(depth, known, image), 3, rtol=1e-3)
