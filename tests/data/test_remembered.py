"""Scenes that are kept once made."""

from __future__ import annotations

import torch
from torch.utils.data import DataLoader

from kornia_tidy.data import DeadLeaves
from kornia_tidy.data.remembered import Remembered
from tests.base import BaseTester


class Counting(DeadLeaves):
    made = 0

    def read(self, index):
        self.made += 1
        return super().read(index)


def same(one, other):
    return all(torch.equal(one[name], other[name]) for name in ("image", "depth", "mask"))


class TestRemembered(BaseTester):
    def test_feature_makes_each_scene_once(self):
        scenes = Counting(3, 24, 24)
        remembered = Remembered(scenes)
        assert len(remembered) == 3
        for _ in range(2):
            assert all(same(remembered[i], DeadLeaves(3, 24, 24)[i]) for i in range(3))
        assert scenes.made == 3

    def test_feature_keeps_no_more_than_the_limit(self):
        scenes = Counting(3, 24, 24)
        size = sum(scenes[0][name].nbytes for name in ("image", "depth", "mask"))
        scenes.made = 0
        remembered = Remembered(scenes, limit=2 * size)
        for index in (0, 1, 2, 0, 1, 2):
            assert same(remembered[index], DeadLeaves(3, 24, 24)[index])
        assert scenes.made == 4

    def test_feature_what_is_done_to_an_item_is_not_remembered(self):
        remembered = Remembered(DeadLeaves(1, 24, 24))
        remembered[0]["image"] = None
        assert remembered[0]["image"] is not None

    def test_feature_workers(self):
        loader = DataLoader(Remembered(DeadLeaves(4, 24, 24)), batch_size=2, num_workers=1)
        for _ in range(2):
            images = torch.cat([batch["image"] for batch in loader])
        assert torch.equal(images[3], DeadLeaves(4, 24, 24)[3]["image"])
