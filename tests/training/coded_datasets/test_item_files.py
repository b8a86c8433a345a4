from __future__ import annotations

import io
import json

import cv2
import numpy as np
import pytest
import torch

from kornia_tidy.training.coded_datasets import Layout
from kornia_tidy.training.coded_datasets.item_files import decode_map, encode_item
from tests.base import BaseTester


@pytest.fixture
def sample():
    depth = torch.rand(1, 5, 7) + 0.3
    depth[0, 0] = float("inf")
    coded = torch.rand(3, 5, 7)
    coded[0, 0, 0], coded[0, 0, 1] = 1.25, -0.25
    mask = torch.rand(1, 5, 7) < 0.5
    clean = torch.rand(3, 5, 7)
    return {"image": coded, "all_in_focus": clean, "depth": depth, "mask": mask, "index": 3, "name": 'a "b", ü'}


class TestItemFiles(BaseTester):
    def test_feature_opencv_and_numpy_read_what_is_written(self, sample):
        files = encode_item(sample, 7, Layout())
        coded = cv2.imdecode(np.frombuffer(files["coded.png"], np.uint8), cv2.IMREAD_UNCHANGED)
        expected = (sample["image"].clamp(0, 1).double() * 65535).round().permute(1, 2, 0).flip(-1)  # OpenCV has BGR
        assert coded.dtype == np.uint16
        assert np.array_equal(coded, expected.numpy())
        assert np.array_equal(np.load(io.BytesIO(files["depth.npy"])), sample["depth"][0].numpy())
        mask = cv2.imdecode(np.frombuffer(files["mask.png"], np.uint8), cv2.IMREAD_UNCHANGED)
        assert np.array_equal(mask, sample["mask"][0].numpy() * np.uint8(255))
        assert json.loads(files["scene.json"]) == {"index": 3, "name": 'a "b", ü', "clamped_pixels": 7}

    def test_feature_floats_are_kept_as_they_are(self, sample):
        files = encode_item(sample, 0, Layout(floats=True))
        assert np.array_equal(np.load(io.BytesIO(files["coded.npy"])), sample["image"].permute(1, 2, 0).numpy())
        assert torch.equal(decode_map("image", files["image.npy"], "here"), sample["all_in_focus"])

    def test_feature_maps_come_back(self, sample):
        files = encode_item(sample, 0, Layout())
        assert torch.equal(decode_map("depth", files["depth.npy"], "here"), sample["depth"])
        assert torch.equal(decode_map("mask", files["mask.png"], "here"), sample["mask"])
        read = decode_map("image", files["image.png"], "here")
        self.assert_close(read, sample["all_in_focus"], rtol=0, atol=0.5 / 65535 + 1e-7)

    @pytest.mark.parametrize("beside", [(), ("depth",), ("image", "mask")])
    def test_cardinality_only_what_is_asked_for(self, beside, sample):
        names = [name.partition(".")[0] for name in encode_item(sample, 0, Layout(beside=beside))]
        assert names == ["coded", *beside, "scene"]

    def test_exception_a_damaged_file_is_named(self, sample):
        data = encode_item(sample, 0, Layout())["coded.png"]
        with pytest.raises(ValueError, match="cannot read here: the file is cut short"):
            decode_map("coded", data[:-20], "here")
