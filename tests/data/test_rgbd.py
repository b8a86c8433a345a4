"""Pictures with depth: sizes that agree, and every real scene against what was measured when it was collected."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from kornia_tidy.data.depth_files import write_depth
from kornia_tidy.data.image_files import write_image
from kornia_tidy.data.rgbd import read_rgbd
from tests.base import BaseTester, shared
from tests.scenes import ENTRIES, NOMINAL_CALIBRATION, load_scene


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

    def test_feature_all_collected_scenes_are_here(self):
        shared("data/scenes.json")
        assert len(ENTRIES) == 35

    @pytest.mark.parametrize("name", ENTRIES)
    def test_feature_real_scene_is_as_measured(self, name):
        """Size, valid share, and 0.5 %, 50 % and 99.5 % quantiles within 1 %, of scenes.json."""
        entry = ENTRIES[name]
        image, depth, valid = load_scene(name)
        assert image.shape == (3, *entry["size"])
        assert depth.shape == valid.shape == (1, *entry["size"])
        assert image.min() >= 0
        assert 0.5 < image.max() <= 1
        assert bool(((depth > 0) & ~depth.isnan()).all())
        assert valid.float().mean().item() == pytest.approx(entry["valid_fraction"], abs=0.0006)
        known = depth[valid].double().numpy()
        if entry["range_unit"] == "disparity px":
            known = NOMINAL_CALIBRATION["focal_px"] * NOMINAL_CALIBRATION["baseline_m"] / known
        np.testing.assert_allclose(np.quantile(known, [0.005, 0.5, 0.995]), entry["range"], rtol=0.01)

    def test_convention_depth_is_not_upside_down(self):
        """Motorcycle: the floor and bike below are nearer than the wall above, in a file whose rows run upwards."""
        depth = load_scene("middlebury-motorcycle").depth
        assert depth[0, -50:].median() < 0.8 * depth[0, :50].median()

    def test_feature_depth_edges_lie_on_image_edges(self):
        """A flipped or shifted map would meet the image's edges no more often than chance."""
        scene = load_scene("flyingthings3d-a0032")
        step = scene.image.diff(dim=2).abs().amax(0)
        edge = (1 / scene.depth[0]).diff(dim=1).abs() > 0.05
        assert step[edge].mean() > 3 * step[edge.flip(0)].mean()
