from __future__ import annotations

import numpy as np
import pytest
import torch

from kornia_tidy.cli.app.scenes import read_files
from kornia_tidy.data import write_image
from tests.base import BaseTester


@pytest.fixture
def files(tmp_path):
    """A photo with two colours and a depth map in millimetres with a hole."""
    image = torch.zeros(3, 60, 90)
    image[0, :, :45], image[2, :, 45:] = 1.0, 1.0
    depth = np.full((60, 90), 1500, np.uint16)
    depth[:, 45:], depth[:10, :10] = 3000, 0
    write_image(tmp_path / "photo.png", image)
    np.save(tmp_path / "depth.npy", depth)
    return tmp_path


class TestReadFiles(BaseTester):
    def test_feature_smaller_files_stay_and_holes_are_marked(self, files):
        scene = read_files(files / "photo.png", files / "depth.npy", 0.001, 96)
        assert scene.image.shape == (3, 60, 90)
        assert scene.depth.unique().tolist() == [1.5, 3.0]
        assert int((~scene.valid).sum()) == 100

    def test_feature_larger_files_are_made_smaller_without_mixing_depths(self, files):
        scene = read_files(files / "photo.png", files / "depth.npy", 0.001, 30)
        assert scene.image.shape == (3, 20, 30)
        assert scene.depth.unique().tolist() == [1.5, 3.0]
        assert scene.valid.dtype == torch.bool
        assert not scene.valid[0, 0, 0]

    def test_feature_a_grey_photo_becomes_rgb(self, files):
        write_image(files / "grey.png", torch.rand(1, 60, 90))
        assert read_files(files / "grey.png", files / "depth.npy", 0.001, 96).image.shape == (3, 60, 90)

    @pytest.mark.parametrize(("scale", "told"), [(1.0, "3e[+]03 m"), (1e-6, "0.003 m")])
    def test_exception_a_wrong_unit(self, files, scale, told):
        with pytest.raises(ValueError, match=rf"the middle depth of depth.npy would be {told}.*choose another unit"):
            read_files(files / "photo.png", files / "depth.npy", scale, 96)
