"""FlyingThings3D: published paths, disparity to metres or to [0, 1], and the patches of the paper."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from kornia_tidy import DefocusRange
from kornia_tidy.data import FlyingThings3D, paper_patches, split_frames
from tests.base import BaseTester
from tests.data.published import flying_things_disparity, write_flying_things, write_pfm


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """Two sequences of two frames in TRAIN/A, one in each other part."""
    root = tmp_path_factory.mktemp("flying_things")
    parts = [f"{split}/{letter}" for split in ("TRAIN", "TEST") for letter in "ABC"]
    write_flying_things(root, {part: 2 if part == "TRAIN/A" else 1 for part in parts})
    return root


class TestFlyingThings3D(BaseTester):
    @pytest.mark.parametrize(
        ("options", "first", "length"),
        [({}, "TRAIN/A/0000/left/0006", 8), ({"split": "test"}, "TEST/A/0000/left/0006", 6)],
    )
    def test_cardinality(self, root, options, first, length):
        data = FlyingThings3D(root, **options)
        names = [data.name(index) for index in range(len(data))]
        assert len(names) == length
        assert names[0] == first
        assert names == sorted(names)

    def test_feature_image_and_disparity_belong_together_in_every_frame(self, root):
        """The files' red is 8 times their disparity, which differs from frame to frame."""
        seen = []
        for split in ("train", "test"):
            for sample in FlyingThings3D(root, split):
                disparity = 1050.0 / sample["depth"][0]
                self.assert_close(8 * disparity / 255, sample["image"][0])
                seen.append(disparity)
        assert len(torch.stack(seen).round().unique(dim=0)) == 14

    def test_convention_depth_is_focal_length_times_baseline_over_disparity(self, root):
        """35 mm over 32 mm of 960 pixels is a focal length of 1050 px; the cameras are one unit apart."""
        disparity = flying_things_disparity(0)
        expected = torch.from_numpy(35 / 32 * 960 / disparity.astype(np.float64))[None]
        self.assert_close(FlyingThings3D(root)[0]["depth"], expected, rtol=1e-6)
        self.assert_close(FlyingThings3D(root, baseline_m=0.05)[0]["depth"], 0.05 * expected, rtol=1e-6)

    def test_convention_normalised_disparity_is_clamped_and_masked(self, root):
        sample = FlyingThings3D(root, disparity_range=(5, 25))[0]
        disparity = torch.from_numpy(flying_things_disparity(0))[None]
        self.assert_close(sample["depth"], ((disparity - 5) / 20).clamp(0, 1), atol=1e-6)
        sure = (disparity - 5.5).abs() > 1  # at the ends themselves rounding decides
        sure &= (disparity - 24.5).abs() > 1
        assert torch.equal(sample["mask"][sure], ((disparity >= 5) & (disparity <= 25))[sure])
        assert 0.1 < sample["mask"].float().mean() < 0.9
        DefocusRange(-20, 20).defocus(sample["depth"])  # refuses what is outside [0, 1]

    def test_feature_zero_disparity_is_infinitely_far(self, tmp_path):
        write_flying_things(tmp_path, {"TRAIN/A": 1})
        disparity = np.full((12, 20), 8, np.float32)
        disparity[3, 4] = 0
        write_pfm(tmp_path / "disparity/TRAIN/A/0000/left/0006.pfm", disparity)
        assert FlyingThings3D(tmp_path)[0]["depth"][0, 3, 4] == torch.inf
        far = FlyingThings3D(tmp_path, disparity_range=(0, 10))[0]
        assert far["depth"][0, 3, 4] == 0
        assert far["mask"].all()

    def test_feature_webp_frames_are_found_where_they_are_unpacked(self, tmp_path):
        write_flying_things(tmp_path, {"TRAIN/A": 1}, frames="frames_cleanpass_webp", suffix=".webp")
        sample = FlyingThings3D(tmp_path)[0]
        self.assert_close(sample["image"][0], 8 * 1050 / sample["depth"][0] / 255)

    def test_exception_missing_data_say_what_to_download(self, tmp_path):
        message = r"download 'RGB images \(cleanpass\)'.* and 'Disparity' .* https://lmb.*cleanpass/TRAIN/A/0000/left"
        with pytest.raises(FileNotFoundError, match=message):
            FlyingThings3D(tmp_path)

    def test_exception_missing_parts_are_named(self, tmp_path):
        write_flying_things(tmp_path, {"TRAIN/A": 1})
        with pytest.raises(FileNotFoundError, match=r"no left frames \*\.png of TEST"):
            FlyingThings3D(tmp_path, "test")

    def test_exception_a_frame_without_disparity_is_found_at_once(self, tmp_path):
        write_flying_things(tmp_path, {"TRAIN/A": 2})
        (tmp_path / "disparity/TRAIN/A/0001/left/0006.pfm").unlink()
        with pytest.raises(ValueError, match=r"1 of 4 frames have no disparity, the first is TRAIN/A/0001/left/0006: "):
            FlyingThings3D(tmp_path)

    @pytest.mark.parametrize(
        ("changed", "message"),
        [
            ({"split": "val"}, "split must be one of 'train', 'test', got 'val'"),
            ({"baseline_m": 0.0}, "baseline_m must be positive"),
            ({"disparity_range": (5, 5)}, "0 <= far < near"),
            ({"disparity_range": (-1, 5)}, "0 <= far < near"),
            ({"disparity_range": (0, float("inf"))}, "0 <= far < near"),
            ({"disparity_range": (0, 9), "baseline_m": 0.1}, "not both"),
        ],
    )
    def test_exception_names_the_bad_value(self, root, changed, message):
        with pytest.raises(ValueError, match=message):
            FlyingThings3D(root, **changed)


@pytest.fixture(scope="module")
def large(tmp_path_factory):
    """Frames that hold a patch: 24 sequences in TRAIN, 3 in TEST."""
    root = tmp_path_factory.mktemp("paper")
    sequences = {"TRAIN/A": 8, "TRAIN/B": 8, "TRAIN/C": 8, "TEST/A": 1, "TEST/B": 1, "TEST/C": 1}
    write_flying_things(root, sequences, size=(280, 290))
    return root


class TestPaperPatches(BaseTester):
    @pytest.mark.parametrize(("split", "length"), [("train", 5077), ("val", 553), ("test", 419)])
    def test_cardinality_is_the_paper_s(self, large, split, length):
        patches = paper_patches(large, split)
        assert len(patches) == length
        sample = patches[length - 1]
        assert sample["image"].shape == (3, 278, 278)
        assert sample["index"] == length - 1
        self.assert_close(sample["depth"], 255 / 8 * sample["image"][:1] / 160)


class TestSplitFrames(BaseTester):
    def test_feature_whole_sequences_are_held_out_and_no_frame_is_in_two_splits(self, tmp_path):
        write_flying_things(tmp_path, {"TRAIN/A": 8, "TRAIN/B": 3, "TRAIN/C": 1, "TEST/A": 1, "TEST/B": 1, "TEST/C": 1})
        names = {
            split: [part.dataset.names[index] for index in part.indices]
            for split in ("train", "val", "test")
            for part in [split_frames(tmp_path, split)]
        }
        sequences = {split: {name.split("/left/")[0] for name in found} for split, found in names.items()}
        assert sequences["val"] == {"TRAIN/B/0001"}  # the tenth of TRAIN
        assert len(sequences["train"]) == 11
        assert not sequences["train"] & sequences["val"]
        assert all(name.startswith("TEST/") for name in names["test"])
        assert sum(map(len, names.values())) == 2 * (12 + 3)

    def test_exception(self, root):
        with pytest.raises(ValueError, match="has 4 sequences of TRAIN: 10 or more are needed to validate"):
            split_frames(root)
        with pytest.raises(ValueError, match="split must be one of 'train', 'val', 'test', got 'validation'"):
            split_frames(root, "validation")
        with pytest.raises(ValueError, match="split must be one of 'train', 'val', 'test', got 'dev'"):
            paper_patches(root, "dev")
