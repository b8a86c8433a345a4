"""How long scenes take: made, written and read."""

from __future__ import annotations

import torch

from kornia_tidy.data import (
    FlyingThings3D,
    NYUDepthV2,
    Patches,
    RGBDFolder,
    dead_leaves,
    read_depth,
    read_image,
    write_depth,
    write_image,
)
from tests.data.published import write_flying_things, write_nyu


class TestData:
    def test_dead_leaves(self, bench, size):
        bench(lambda: dead_leaves(size, size))

    def test_picture_written_and_read(self, bench, size, tmp_path):
        image = torch.rand(3, size, size)
        bench(lambda: (write_image(tmp_path / "image.png", image), read_image(tmp_path / "image.png")))

    def test_depth_written_and_read(self, bench, size, tmp_path):
        depth = 1 + torch.rand(1, size, size)
        bench(lambda: (write_depth(tmp_path / "depth.pfm", depth), read_depth(tmp_path / "depth.pfm")))

    def test_frame_of_flying_things(self, bench, size, tmp_path):
        write_flying_things(tmp_path, {"TRAIN/A": 1}, size=(size, size))
        frames = FlyingThings3D(tmp_path, disparity_range=(0, 160))
        bench(lambda: frames[0])

    def test_patch_of_a_quarter_of_a_frame(self, bench, size, tmp_path):
        write_flying_things(tmp_path, {"TRAIN/A": 1}, size=(size, size))
        patches = Patches(FlyingThings3D(tmp_path, disparity_range=(0, 160)), size // 2)
        bench(lambda: patches[0])

    def test_pair_in_a_folder(self, bench, size, tmp_path):
        write_image(tmp_path / "a.png", torch.rand(3, size, size))
        write_depth(tmp_path / "a_depth.png", 1 + torch.rand(1, size, size), scale=0.001)
        pairs = RGBDFolder(tmp_path, "*.png", "*_depth.png", scale=0.001)
        bench(lambda: pairs[0])

    def test_frame_of_nyu_480x640(self, bench, tmp_path):
        write_nyu(tmp_path, 1)
        frames = NYUDepthV2(tmp_path, "all")
        bench(lambda: frames[0], size=0)
