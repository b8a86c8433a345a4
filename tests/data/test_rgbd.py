"""Pictures with depth: sizes that agree, and every real scene against what was measured when it was collected."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from kornia_tidy.data import read_rgbd, write_depth, write_image
from tests.base import BaseTester
from tests.scenes import load_scene


class TestReadRgbd(BaseTester):
    def test_smoke(self, tmp_path):
        image, depth = torch.rand(3, 5, 8), torch.rand(1, 5, 8) + 1
        write_image(tmp_path / "image.png", image, bits=16)
        write_depth(tmp_path / "depth.pfm", depth)
        scene = read_rgbd(tmp_path / "image.png", tmp_path / "depth.pfm")
        self.assert_close(scene.image, image, rtol=0, atol=1e-5)
        assert torch.equal(scene.depth, depth)
        assert scene.valid.all()

    def test_exception_names_both_sizes(self, tmp_path):
        write_image(tmp_path / "image.png", torch.rand(3, 5, 8))
        write_depth(tmp_path / "depth.pfm", torch.ones(1, 8, 5))
        with pytest.raises(ValueError, match=r"image\.png has 5 x 8, .*depth\.pfm has 8 x 5"):
            read_rgbd(tmp_path / "image.png", tmp_path / "depth.pfm")

    def test_feature_the_image_is_averaged_or_the_depth_takes_the_nearest_pixel(self, tmp_path):
        image = torch.rand(3, 8, 12)
        depth = torch.rand(1, 4, 6) + 1
        write_image(tmp_path / "image.png", image, bits=16)
        write_depth(tmp_path / "depth.pfm", depth)
        paths = tmp_path / "image.png", tmp_path / "depth.pfm"
        small, large = (read_rgbd(*paths, resample=which) for which in ("image", "depth"))
        self.assert_close(small.image, torch.nn.functional.avg_pool2d(image, 2), rtol=0, atol=1e-4)
        assert torch.equal(small.depth, depth)
        assert torch.equal(large.depth, depth.repeat_interleave(2, 1).repeat_interleave(2, 2))
        self.assert_close(large.image, image, rtol=0, atol=1e-4)
        assert large.valid.shape == large.depth.shape

    def test_feature_grey_images_and_larger_depth(self, tmp_path):
        write_image(tmp_path / "image.png", torch.full((1, 4, 6), 0.5))
        write_depth(tmp_path / "depth.pfm", torch.ones(1, 8, 12))
        scene = read_rgbd(tmp_path / "image.png", tmp_path / "depth.pfm", resample="image")
        self.assert_close(scene.image, torch.full((1, 8, 12), 0.5), rtol=0, atol=0.003)

    def test_feature_guided_fill_leaves_the_mask(self, tmp_path):
        image = torch.zeros(3, 20, 30)
        image[..., 15:] = 1
        depth = np.where(np.arange(30) < 15, 1.0, 3.0) * np.ones((20, 1))
        known = np.random.default_rng(0).random((20, 30)) < 0.2
        write_image(tmp_path / "image.png", image)
        np.save(tmp_path / "depth.npy", np.where(known, depth, 0).astype(np.float32))
        nearest, guided = (
            read_rgbd(tmp_path / "image.png", tmp_path / "depth.npy", fill=fill) for fill in ("nearest", "guided")
        )
        assert torch.equal(guided.valid, nearest.valid)
        assert (guided.valid[0].numpy() == known).all()
        errors = [np.abs(scene.depth[0].numpy() - depth).mean() for scene in (nearest, guided)]
        assert errors[1] < 0.1 * errors[0]

    def test_exception_other_ratios_and_options(self, tmp_path):
        write_image(tmp_path / "image.png", torch.rand(3, 100, 150))
        write_depth(tmp_path / "depth.pfm", torch.ones(1, 50, 77))
        paths = tmp_path / "image.png", tmp_path / "depth.pfm"
        with pytest.raises(ValueError, match=r"their sides have other ratios: .* has 100 x 150, .* has 50 x 77"):
            read_rgbd(*paths, resample="image")
        with pytest.raises(ValueError, match="resample must be one of None, 'image', 'depth', got 'area'"):
            read_rgbd(*paths, resample="area")
        with pytest.raises(ValueError, match="fill must be one of 'nearest', 'guided', got 'linear'"):
            read_rgbd(*paths, fill="linear")

    def test_convention_depth_is_not_upside_down(self):
        """Motorcycle: the floor and bike below are nearer than the wall above, in a file whose rows run upwards."""
        depth = load_scene("middlebury-motorcycle").depth
        assert depth[0, -50:].median() < 0.8 * depth[0, :50].median()
