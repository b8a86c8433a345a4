"""SUN RGB-D: frames found in the published folders, and bits rotated back."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch

from kornia_tidy.data import SUNRGBD
from tests.base import BaseTester


def write(root, frame, millimetres, part="depth_bfx"):
    folder = root / frame
    for name in ("image", part):
        (folder / name).mkdir(parents=True, exist_ok=True)
    depth = np.full((4, 6), millimetres, np.uint32)
    depth[1, 2] = 0
    rotated = ((depth << 3) | (depth >> 13)).astype(np.uint16)
    assert cv2.imwrite(str(folder / "image" / "any name.jpg"), np.full((4, 6, 3), 90, np.uint8))
    assert cv2.imwrite(str(folder / part / "another.png"), rotated)
    (folder / "intrinsics.txt").write_text("520 0 3 0 520 2 0 0 1")


class TestSUNRGBD(BaseTester):
    def test_feature_frames_and_depth(self, tmp_path):
        for frame, millimetres in (("kv2/kinect2data/000002", 9000), ("kv1/NYUdata/NYU0001", 1234)):
            write(tmp_path, frame, millimetres)
        data = SUNRGBD(tmp_path)
        assert [sample["name"] for sample in data] == ["kv1/NYUdata/NYU0001", "kv2/kinect2data/000002"]
        for sample, metres in zip(
            data, (1.234, 9.0), strict=True
        ):  # 9000 << 3 is beyond 16 bits: the top bits come back
            self.assert_close(sample["depth"], torch.full((1, 4, 6), metres))
            assert (~sample["mask"]).nonzero().tolist() == [[0, 1, 2]]

    def test_exception(self, tmp_path):
        with pytest.raises(FileNotFoundError, match="there is no folder"):
            SUNRGBD(tmp_path / "a")
        with pytest.raises(FileNotFoundError, match="a frame is a folder with image/ and depth_bfx/"):
            SUNRGBD(tmp_path)
        write(tmp_path, "a", 1)
        (tmp_path / "a/image/second.jpg").touch()
        with pytest.raises(ValueError, match="image should hold one file, found 2"):
            SUNRGBD(tmp_path)
