"""Patches: cut alike from every map, and the same whenever and wherever they are asked for."""

from __future__ import annotations

import hypothesis.strategies as st
import pytest
import torch
from hypothesis import given, settings
from torch.utils.data import Dataset, Subset

from kornia_tidy import TiDyOptics
from kornia_tidy.data import DeadLeaves, Patches, UnreadableItemError, central_crop, crop, random_crop
from tests.base import BaseTester
from tests.camera.pipeline_samples import FAST


def numbered(height, width):
    """Maps whose every pixel says where it is."""
    place = torch.arange(height * width, dtype=torch.float32).view(1, height, width)
    return {"image": place.repeat(3, 1, 1), "depth": place + 0.5, "mask": place % 3 == 0, "index": 9, "name": "n"}


class Numbered(Dataset):
    """Scenes whose depth says which scene and which pixel it is from."""

    def __init__(self, length, height=20, width=30):
        self.length, self.size = length, (height, width)

    def __len__(self):
        return self.length

    def __getitem__(self, index):
        sample = numbered(*self.size)
        return {**sample, "depth": sample["depth"] + 10_000 * index, "index": index, "name": f"scene {index}"}


def scene_of(patch):
    return int(patch["depth"][0, 0, 0]) // 10_000


class TestCrop(BaseTester):
    @settings(max_examples=60)
    @given(st.data())
    def test_property_every_map_is_the_same_window(self, data):
        height, width = data.draw(st.integers(1, 12)), data.draw(st.integers(1, 12))
        size = (data.draw(st.integers(1, height)), data.draw(st.integers(1, width)))
        sample = numbered(height, width)
        cut = random_crop(sample, size, torch.Generator().manual_seed(data.draw(st.integers(0, 99))))
        top, left = divmod(int(cut["image"][0, 0, 0]), width)
        for key in ("image", "depth", "mask"):
            assert cut[key].shape[-2:] == size
            assert torch.equal(cut[key], sample[key][:, top : top + size[0], left : left + size[1]])
        assert (cut["index"], cut["name"]) == (9, "n")

    @pytest.mark.parametrize(("size", "corner"), [((5, 7), (0, 0)), ((3, 3), (1, 2)), ((2, 4), (1, 1))])
    def test_feature_the_middle(self, size, corner):
        sample = numbered(5, 7)
        cut = central_crop(sample, size)
        assert divmod(int(cut["image"][0, 0, 0]), 7) == corner
        assert all(torch.equal(cut[key], crop(sample, *corner, *size)[key]) for key in ("image", "depth", "mask"))

    def test_feature_every_place_is_drawn_as_often(self):
        """4 x 3 places, 2400 draws: 200 each, and within five standard deviations of 13.5."""
        generator, sample = torch.Generator().manual_seed(0), numbered(5, 6)
        corners = [int(random_crop(sample, (2, 4), generator)["image"][0, 0, 0]) for _ in range(2400)]
        seen, counts = torch.tensor(corners).unique(return_counts=True)
        assert seen.tolist() == [6 * row + column for row in range(4) for column in range(3)]
        assert (counts - 200).abs().max() < 68

    def test_feature_what_is_not_as_large_as_the_image_is_passed_on(self):
        sample = {**numbered(8, 8), "psf": torch.ones(3, 5, 5), "label": torch.tensor(3)}
        cut = crop(sample, 1, 2, 4, 4)
        assert cut["psf"] is sample["psf"]
        assert cut["label"] is sample["label"]
        assert sample["image"].shape == (3, 8, 8)

    @pytest.mark.parametrize("window", [(-1, 0, 2, 2), (0, 0, 9, 2), (0, 5, 2, 4), (0, 0, -1, 2)])
    def test_exception_window_outside(self, window):
        with pytest.raises(ValueError, match="does not lie inside an image of 8 x 8"):
            crop(numbered(8, 8), *window)

    @pytest.mark.parametrize("size", [0, -3, (4, 0)])
    def test_exception_size(self, size):
        with pytest.raises(ValueError, match="size must be a positive number of pixels"):
            random_crop(numbered(8, 8), size)

    def test_exception_larger_than_the_image(self):
        with pytest.raises(ValueError, match="a patch of 4 x 9 pixels does not fit into an image of 8 x 8"):
            random_crop(numbered(8, 8), (4, 9))


class TestPatches(BaseTester):
    def test_feature_every_scene_is_used_before_one_is_used_again(self):
        patches = Patches(Numbered(7), 5, count=16)
        scenes = [scene_of(patches[index]) for index in range(16)]
        assert sorted(scenes[:7]) == sorted(scenes[7:14]) == list(range(7))
        assert scenes[:7] == scenes[7:14] != list(range(7))
        assert patches[1]["name"] != patches[8]["name"]  # the same scene, at another place

    def test_feature_name_says_where_the_patch_is_from(self):
        for index in range(5):
            sample = Patches(Numbered(5), (4, 6))[index]
            top, left = divmod(int(sample["image"][0, 0, 0]), 30)
            assert sample["name"] == f"scene {scene_of(sample)}@{top},{left}"

    def test_feature_patches_follow_from_seed_and_index_only(self):
        one, same, other = (Patches(Numbered(50), 5, seed=seed) for seed in (1, 1, 2))
        one[3], one[4]
        torch.manual_seed(99)
        before = torch.get_rng_state()
        assert torch.equal(one[7]["depth"], same[7]["depth"])
        assert torch.equal(torch.get_rng_state(), before)
        assert sum(torch.equal(one[index]["depth"], other[index]["depth"]) for index in range(50)) < 3

    def test_feature_subsets_and_negative_indices(self):
        patches = Patches(Subset(Numbered(10), [3, 8]), 5)
        assert {scene_of(patches[0]), scene_of(patches[1])} == {3, 8}
        assert torch.equal(patches[-1]["depth"], patches[1]["depth"])
        assert len(list(patches)) == 2

    def test_feature_the_transform_sees_the_patch(self):
        transform = TiDyOptics(fidelity=FAST).as_transform(seed=1)
        patches = Patches(DeadLeaves(2, 60, 70, num_leaves=60), 48)
        sample = Patches(patches.scenes, 48, transform=transform)[1]
        assert torch.equal(sample["all_in_focus"], patches[1]["image"])
        assert torch.equal(sample["image"], transform(patches[1])["image"])

    def test_exception_a_frame_smaller_than_the_patch_is_named(self):
        with pytest.raises(UnreadableItemError, match="patch 2: a patch of 40 x 40 pixels does not fit into"):
            Patches(Numbered(3), 40)[2]

    @pytest.mark.parametrize(
        ("scenes", "options", "message"),
        [
            (Numbered(0), {}, "at least one scene"),
            (iter([]), {}, "at least one scene"),
            (Numbered(2), {"count": 0}, "count must be a positive number of patches, got 0"),
            (Numbered(2), {"size": 0}, "size must be a positive number"),
        ],
    )
    def test_exception_names_the_bad_value(self, scenes, options, message):
        with pytest.raises(ValueError, match=message):
            Patches(scenes, **{"size": 4, **options})

    def test_exception_index(self):
        with pytest.raises(IndexError, match="item 2 of a data set of 2"):
            Patches(Numbered(2), 4)[2]
