"""NYU Depth v2: MATLAB's axes, the official split, holes and borders, and files that are not what they should be."""

from __future__ import annotations

import shutil
import sys

import h5py
import numpy as np
import pytest
import torch

from kornia_tidy.data import NYUDepthV2, UnreadableItemError
from tests.base import BaseTester
from tests.data.published import write_nyu


@pytest.fixture(scope="module")
def published(tmp_path_factory):
    root = tmp_path_factory.mktemp("nyu")
    return root, *write_nyu(root)


@pytest.fixture
def copy(published, tmp_path):
    for file in published[0].iterdir():
        shutil.copy(file, tmp_path)
    return tmp_path


class TestNYUDepthV2(BaseTester):
    @pytest.mark.parametrize(("split", "numbers"), [("train", [2, 4]), ("test", [1, 3, 5]), ("all", [1, 2, 3, 4, 5])])
    def test_feature_split_is_the_official_one_and_counts_from_one(self, published, split, numbers):
        root, images, _, _ = published
        data = NYUDepthV2(root, split)
        assert len(data) == len(numbers)
        for index, number in enumerate(numbers):
            sample = data[index]
            assert sample["name"] == f"{number:04d}"
            assert sample["index"] == index
            expected = images[44:471, 40:601, :, number - 1].transpose(2, 0, 1) / 255
            self.assert_close(sample["image"], torch.from_numpy(expected), rtol=0, atol=1e-7)

    def test_convention_axes_are_those_of_matlab(self, published):
        root, images, depths, _ = published
        sample = NYUDepthV2(root, "all")[2]
        assert sample["depth"].shape == sample["mask"].shape == (1, 427, 561)
        assert sample["image"].dtype == sample["depth"].dtype == torch.float32
        for row, column in [(0, 560), (426, 0), (25, 301)]:
            pixel = row + 44, column + 40
            assert (sample["image"][:, row, column] * 255).round().tolist() == images[*pixel, :, 2].tolist()
            assert sample["depth"][0, row, column].item() == depths[*pixel, 2]

    def test_convention_crop_is_the_toolbox_s(self, published):
        """MATLAB's rows 45:471 and columns 41:601, both ends included."""
        root, _, depths, _ = published
        sample = NYUDepthV2(root, "all")[0]
        assert sample["image"].shape == (3, 427, 561)
        assert np.array_equal(sample["depth"][0].numpy(), depths[45 - 1 : 471, 41 - 1 : 601, 0])
        assert sample["depth"].is_contiguous()
        assert sample["image"].is_contiguous()

    def test_exception_missing_files_say_what_to_download(self, copy):
        (copy / "splits.mat").unlink()
        assert len(NYUDepthV2(copy, "all")) == 5
        with pytest.raises(FileNotFoundError, match=r"download http.*splits\.mat and keep it as .*splits\.mat"):
            NYUDepthV2(copy, "train")
        with pytest.raises(FileNotFoundError, match=r"download http.*labeled\.mat \(2\.8 GB\) and keep it as"):
            NYUDepthV2(copy / "nowhere")
        with pytest.raises(ValueError, match=r"split must be one of 'train', 'test', 'all', got 'tset'"):
            NYUDepthV2(copy, "tset")

    def test_exception_without_h5py_names_the_extra(self, published, monkeypatch):
        monkeypatch.setitem(sys.modules, "h5py", None)
        with pytest.raises(ImportError, match=r"needs h5py: pip install 'kornia-tidy\[data\]'"):
            NYUDepthV2(published[0])

    def test_exception_damaged_split(self, copy):
        (copy / "splits.mat").write_bytes(b"no matlab")
        with pytest.raises(ValueError, match=r"cannot read .*splits\.mat: it should hold trainNdxs"):
            NYUDepthV2(copy, "train")

    @pytest.mark.parametrize("kept", [100, 300_000])
    def test_exception_cut_short(self, copy, kept):
        path = copy / "nyu_depth_v2_labeled.mat"
        path.write_bytes(path.read_bytes()[: min(kept, path.stat().st_size // 2)])
        with pytest.raises(ValueError, match=r"labeled\.mat: it is not a MATLAB 7\.3 \(HDF5\) file, or it is damaged"):
            NYUDepthV2(copy, "all")

    def test_exception_other_content(self, tmp_path):
        with h5py.File(tmp_path / "nyu_depth_v2_labeled.mat", "w") as file:
            file["images"] = np.zeros((2, 3, 640, 480), np.uint8)
        with pytest.raises(ValueError, match=r"should hold .*'depths': \(2, 640, 480\).*found .*'depths': None"):
            NYUDepthV2(tmp_path, "all")

    def test_exception_a_damaged_frame_is_named_and_the_others_are_read(self, copy):
        path = copy / "nyu_depth_v2_labeled.mat"
        with h5py.File(path) as file:
            chunk = file["images"].id.get_chunk_info(3)
            start = chunk.byte_offset + file.userblock_size
        if path.read_bytes()[start : start + 1] != b"\x78":  # zlib's first byte; the offset may count the user block
            start -= 512
        with path.open("r+b") as file:
            file.seek(start)
            assert file.read(1) == b"\x78"
            file.write(bytes(200))
        data = NYUDepthV2(copy, "all")
        with pytest.raises(UnreadableItemError, match=r"^item 3 of NYUDepthV2, 0004: cannot read .*labeled\.mat: "):
            data[3]
        assert data[2]["name"] == "0003"
        assert data[4]["name"] == "0005"

    def test_exception_a_frame_without_depth(self, copy):
        with h5py.File(copy / "nyu_depth_v2_labeled.mat", "r+") as file:
            file["depths"][1] = 0
        with pytest.raises(UnreadableItemError, match=r"item 1 .*0002: .*no valid depth at any pixel"):
            NYUDepthV2(copy, "all")[1]
