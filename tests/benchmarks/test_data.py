"""How long scenes take: made, written and read."""

from __future__ import annotations

import torch

from kornia_tidy.data import dead_leaves, read_depth, read_image, write_depth, write_image


class TestData:
    def test_dead_leaves(self, bench, size):
        bench(lambda: dead_leaves(size, size))

    def test_picture_written_and_read(self, bench, size, tmp_path):
        image = torch.rand(3, size, size)
        bench(lambda: (write_image(tmp_path / "image.png", image), read_image(tmp_path / "image.png")))

    def test_depth_written_and_read(self, bench, size, tmp_path):
        depth = 1 + torch.rand(1, size, size)
        bench(lambda: (write_depth(tmp_path / "depth.pfm", depth), read_depth(tmp_path / "depth.pfm")))
