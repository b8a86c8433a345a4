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
        data = NYUDepthV2(root, split, crop_border=False)
        assert len(data) == len(numbers)
        for index, number in enumerate(numbers):
            sample = data[index]
            assert sample["name"] == f"{number:04d}"
            assert sample["index"] == index
            expected = images[..., number - 1].transpose(2, 0, 1) / 255
            self.assert_close(sample["image"], torch.from_numpy(expected), rtol=0, atol=1e-7)

    def test_convention_axes_are_those_of_matlab(self, published):
        root, images, depths, _ = published
        sample = NYUDepthV2(root, "all", crop_border=False)[2]
        assert sample["image"].shape == (3, 480, 640)
        assert sample["depth"].shape == sample["mask"].shape == (1, 480, 640)
        assert sample["image"].dtype == sample["depth"].dtype == torch.float32
        for row, column in [(0, 639), (479, 0), (25, 301)]:
            assert (sample["image"][:, row, column] * 255).round().tolist() == images[row, column, :, 2].tolist()
            assert sample["depth"][0, row, column].item() == depths[row, column, 2]

    def test_convention_crop_is_the_toolbox_s(self, published):
        """MATLAB's rows 45:471 and columns 41:601, both ends included."""
        root, _, depths, _ = published
        sample = NYUDepthV2(root, "all")[0]
        assert sample["image"].shape == (3, 427, 561)
        assert np.array_equal(sample["depth"][0].numpy(), depths[45 - 1 : 471, 41 - 1 : 601, 0])
        assert sample["depth"].is_contiguous()
        assert sample["image"].is_contiguous()

    def test_feature_raw_depth_has_holes_in_the_mask_and_neighbours_in_the_depth(self, published):
        root, _, _, raw = published
        filled, measured = (NYUDepthV2(root, "all", raw=raw, crop_border=False)[1] for raw in (False, True))
        assert filled["mask"].all()
        assert np.array_equal(measured["mask"][0].numpy(), raw[..., 1] > 0)
        known = measured["mask"]
        assert torch.equal(measured["depth"][known], filled["depth"][known])
        assert measured["depth"].min() >= 0.7
        assert measured["depth"][0, 101, 230] == filled["depth"][0, 99, 230]  # two rows below the hole's upper edge

    def test_feature_split_may_be_a_list_of_numbers(self, published, tmp_path):
        (tmp_path / "mine.txt").write_text("5\n1\n")
        data = NYUDepthV2(published[0], tmp_path / "mine.txt")
        assert [data[index]["name"] for index in range(2)] == ["0005", "0001"]

    def test_exception_missing_files_say_what_to_download(self, copy):
        (copy / "splits.mat").unlink()
        assert len(NYUDepthV2(copy, "all")) == 5
        with pytest.raises(FileNotFoundError, match=r"download http.*splits\.mat and keep it as .*splits\.mat"):
            NYUDepthV2(copy, "train")
        with pytest.raises(FileNotFoundError, match=r"download http.*labeled\.mat \(2\.8 GB\) and keep it as"):
            NYUDepthV2(copy / "nowhere")
        with pytest.raises(FileNotFoundError, match=r"split must be 'train', 'test', 'all' or a text file.*tset"):
            NYUDepthV2(copy, "tset")

    def test_exception_without_h5py_names_the_extra(self, published, monkeypatch):
        monkeypatch.setitem(sys.modules, "h5py", None)
        with pytest.raises(ImportError, match=r"needs h5py: pip install 'kornia-tidy\[data\]'"):
            NYUDepthV2(published[0])

    @pytest.mark.parametrize(
        ("text", "message"), [("1\ntwo", "one a line: .*'two'"), ("3 3", "each once"), (" ", "each")]
    )
    def test_exception_bad_list(self, published, tmp_path, text, message):
        (tmp_path / "mine.txt").write_text(text)
        with pytest.raises(ValueError, match=rf"mine\.txt: .*{message}"):
            NYUDepthV2(published[0], tmp_path / "mine.txt")

    def test_exception_list_beyond_the_file(self, published, tmp_path):
        (tmp_path / "mine.txt").write_text("1\n6")
        with pytest.raises(ValueError, match=r"names frame 6, and .* has frames 1 to 5"):
            NYUDepthV2(published[0], tmp_path / "mine.txt")

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
            file["rawDepths"][1] = 0
        assert NYUDepthV2(copy, "all")[1]["mask"].all()
        with pytest.raises(UnreadableItemError, match=r"item 1 .*0002: .*no valid depth at any pixel"):
            NYUDepthV2(copy, "all", raw=True)[1]
