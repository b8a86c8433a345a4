from __future__ import annotations

import random

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.utils.data import Dataset

from kornia_tidy.training.scenes import Broken, EpochBatches, RepeatableScenes, SceneLoader
from tests.base import BaseTester

pytestmark = pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")


class Noisy(Dataset):
    """Scenes that draw from all global generators, one of them broken if wanted."""

    def __init__(self, count=7, broken=None, sizes=(8,)):
        self.count, self.broken, self.sizes = count, broken, sizes

    def __len__(self):
        return self.count

    def __getitem__(self, index):
        if index == self.broken:
            raise ValueError("cannot read /data/07.png: the file is cut short")
        size = self.sizes[index % len(self.sizes)]
        image = torch.rand(3, size, size) * random.random() * np.random.rand()  # noqa: NPY002
        return {"image": image, "depth": torch.full((1, size, size), 1.0 + index), "index": index}


def same(one, other):
    return all(torch.equal(a[k], b[k]) for a, b in zip(one, other, strict=True) for k in ("image", "depth", "mask"))


class TestEpochBatches(BaseTester):
    @given(length=st.integers(1, 40), batch=st.integers(1, 5), world=st.integers(1, 3), seed=st.integers(0, 9))
    def test_feature_processes_share_an_epoch_without_repeats_and_in_step(self, length, batch, world, seed):
        if length < batch * world:
            with pytest.raises(ValueError, match="do not fill a batch"):
                EpochBatches(length, batch, world=world)
            return
        shares = [list(EpochBatches(length, batch, seed=seed, rank=r, world=world)) for r in range(world)]
        whole = list(EpochBatches(length, batch, seed=seed))
        turns = [batches for turn in zip(*shares, strict=True) for batches in turn]
        assert turns == whole[: len(turns)]
        indices = [index for batches in whole for _, index in batches]
        assert len(set(indices)) == len(indices) == length // batch * batch

    def test_feature_epochs_differ_and_repeat(self):
        batches = EpochBatches(50, 5)
        orders = []
        for epoch in (0, 1, 0):
            batches.set_epoch(epoch)
            orders.append([index for part in batches for _, index in part])
        assert orders[0] == orders[2] != orders[1]

    def test_feature_the_middle_of_an_epoch_is_its_rest(self):
        batches = EpochBatches(20, 3)
        whole = list(batches)
        batches.start(0, 4)
        assert list(batches) == whole[4:]
        assert len(batches) == len(whole)
        batches.set_epoch(0)  # the same epoch: nothing changes
        assert batches.first == 4
        batches.set_epoch(1)
        assert batches.first == 0


class TestSceneLoader(BaseTester):
    @pytest.mark.parametrize("workers", [0, 2])
    def test_feature_batches_go_on_where_a_state_says_with_any_number_of_workers(self, workers):
        loader = SceneLoader(Noisy(), 2, augment=True)
        whole = list(loader)
        other = SceneLoader(Noisy(), 2, augment=True, workers=workers)
        other.load_state_dict({"epoch": 0, "batches": 1})
        rest = list(other)
        assert same(rest, whole[1:])
        assert [b["noise_seed"] for b in rest] == [b["noise_seed"] for b in whole[1:]]
        assert other.state_dict() == loader.state_dict() == {"epoch": 0, "batches": 3}

    def test_feature_the_state_counts_what_was_handed_out_not_what_workers_prepared(self):
        loader = SceneLoader(Noisy(), 1, workers=1)
        iterator = iter(loader)
        next(iterator), next(iterator)
        assert loader.state_dict()["batches"] == 2
        iterator.close()

    def test_feature_validation_is_the_same_in_every_epoch(self):
        loader = SceneLoader(Noisy(), 2, train=False)
        whole = list(loader)
        loader._batches.set_epoch(3)
        again = list(loader)
        assert len(again) == 4
        assert same(whole, again)
        assert [b["noise_seed"] for b in whole] == [b["noise_seed"] for b in again]

    def test_feature_noise_seeds_follow_the_scenes_and_the_epoch(self):
        loader = SceneLoader(Noisy(), 1)
        seeds = [batch["noise_seed"] for batch in loader]
        loader._batches.set_epoch(1)
        again = [batch["noise_seed"] for batch in loader]
        assert len({*seeds, *again}) == 14

    @pytest.mark.parametrize("workers", [0, 1])
    def test_exception_a_broken_scene_is_told_by_its_reason_without_a_traceback(self, workers):
        batches = list(SceneLoader(Noisy(broken=3), 1, train=False, workers=workers))
        assert batches[3] == Broken(
            "scene 3 of the data cannot be used: cannot read /data/07.png: the file is cut short"
        )
        assert sum(isinstance(batch, Broken) for batch in batches) == 1

    def test_exception_sizes_that_differ_are_named(self):
        (batch, *_) = SceneLoader(Noisy(sizes=(8, 9)), 2, train=False)
        assert "must have one size, got [(3, 8, 8), (3, 9, 9)]" in batch.reason

    def test_feature_augmentation_flips_all_maps_alike(self):
        class Ramp(Dataset):
            def __len__(self):
                return 1

            def __getitem__(self, index):
                ramp = torch.linspace(0.1, 0.5, 12).view(1, 3, 4)
                return {"image": ramp.expand(3, 3, 4), "depth": ramp, "mask": ramp > 0.2}

        scenes = RepeatableScenes(Ramp(), augment=True)
        corners, gains = set(), []
        for epoch in range(40):
            item = scenes[epoch, 0]
            ratio = item["image"] / item["depth"]
            self.assert_close(ratio, ratio[:1, :1, :1].expand(3, 3, 4))
            assert torch.equal(item["mask"], item["depth"] > 0.2)
            gains.append(float(ratio[0, 0, 0]))
            corners.add(round(float(item["depth"][0, 0, 0]), 3))
        assert len(corners) == 4
        assert 0.8 <= min(gains) < 0.85
        assert 1.05 < max(gains) <= 1.1
