"""Published data sets in their folders: made in the same layout, and the real files that are at hand."""

from __future__ import annotations

import cv2
import h5py
import numpy as np
import pytest
import torch

from kornia_tidy.data import hypersim, kitti, middlebury, scannet, seven_scenes
from tests.base import BaseTester
from tests.data.published import write_pfm

CALIB = "cam0=[1000 0 4; 0 1000 3; 0 0 1]\ncam1=[1000 0 4; 0 1000 3; 0 0 1]\ndoffs=2\nbaseline=100\nwidth=8\nheight=6\n"


def write_picture(path, values):
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), values)


def picture(height=6, width=8, value=100):
    return np.full((height, width, 3), value, np.uint8)


class TestMiddlebury(BaseTester):
    @pytest.mark.parametrize("name", ["disp0.pfm", "disp0GT.pfm"])
    def test_feature_each_scene_has_its_own_calibration(self, name, tmp_path):
        for scene, focal in (("Adirondack", 1000), ("Piano", 2000)):
            write_picture(tmp_path / scene / "im0.png", picture())
            disparity = np.full((6, 8), 48.0, np.float32)
            disparity[2, 3] = np.inf
            write_pfm(tmp_path / scene / name, disparity)
            (tmp_path / scene / "calib.txt").write_text(CALIB.replace("1000", str(focal)))
        for sample, expected in zip(middlebury(tmp_path), (2.0, 4.0), strict=True):
            self.assert_close(sample["depth"], torch.full((1, 6, 8), expected))  # f B / (48 + 2), the hole filled
            assert (~sample["mask"]).nonzero().tolist() == [[0, 2, 3]]

    def test_exception(self, tmp_path):
        with pytest.raises(FileNotFoundError, match="there is no folder"):
            middlebury(tmp_path / "a")
        with pytest.raises(FileNotFoundError, match=r"Middlebury is not in .* \*/im0.png with \*/disp0"):
            middlebury(tmp_path)
        write_picture(tmp_path / "a" / "im0.png", picture())
        write_pfm(tmp_path / "a" / "disp0.pfm", np.ones((6, 8), np.float32))
        with pytest.raises(FileNotFoundError, match=r"calib\.txt, the calibration of a$"):
            middlebury(tmp_path)


class TestSevenScenes(BaseTester):
    @pytest.mark.parametrize("folder", ["seq-01", "."])
    def test_feature_millimetres_and_two_values_for_unknown(self, folder, tmp_path):
        depth = np.full((6, 8), 1500, np.uint16)
        depth[0, 0], depth[5, 7] = 0, 65535
        for frame in ("000000", "000001"):
            write_picture(tmp_path / folder / f"frame-{frame}.color.png", picture())
            write_picture(tmp_path / folder / f"frame-{frame}.depth.png", depth)
            (tmp_path / folder / f"frame-{frame}.pose.txt").write_text("1 0 0 0")
        data = seven_scenes(tmp_path)
        assert len(data) == 2
        self.assert_close(data[1]["depth"], torch.full((1, 6, 8), 1.5))
        assert (~data[1]["mask"]).nonzero().tolist() == [[0, 0, 0], [0, 5, 7]]


class TestScanNet(BaseTester):
    def test_feature_images_are_averaged_to_the_size_of_the_depth(self, tmp_path):
        stripes = np.zeros((968, 1296, 3), np.uint8)
        stripes[:, ::2] = 200
        depth = np.full((480, 640), 2500, np.uint16)
        depth[:9], depth[9:11] = 0, 65535
        write_picture(tmp_path / "scene0000_00/color/0.jpg", stripes)
        write_picture(tmp_path / "scene0000_00/depth/0.png", depth)
        (sample,) = scannet(tmp_path)
        assert sample["image"].shape == (3, 480, 640)
        assert sample["image"].std() < 0.02  # averaged, where the nearest pixel would give stripes
        self.assert_close(sample["depth"].unique(), torch.tensor([2.5]))
        assert sample["mask"].float().mean().item() == pytest.approx(469 / 480)


class TestKitti(BaseTester):
    def test_feature_sparse_depth_is_filled_along_the_edges_of_the_image(self, tmp_path):
        rows, columns = np.indices((60, 120))
        near = columns > 40 + rows / 2
        metres = np.where(near, 5.0, 20.0)
        known = np.random.default_rng(0).random(near.shape) < 0.1
        drive, frame = "2011_09_26_drive_0002_sync", "0000000005"
        depth = np.where(known, metres * 256, 0).astype(np.uint16)
        write_picture(tmp_path / f"image/{drive}_image_{frame}_image_02.png", np.repeat(near[..., None] * 200, 3, 2))
        write_picture(tmp_path / f"groundtruth_depth/{drive}_groundtruth_depth_{frame}_image_02.png", depth)
        (sample,) = kitti(tmp_path)
        assert sample["name"] == f"{drive}/{frame}/02"
        assert (sample["mask"][0].numpy() == known).all()
        wrong = (sample["depth"][0] / torch.from_numpy(metres) - 1).abs() > 0.05
        assert wrong.float().mean() < 0.01


class TestHypersim(BaseTester):
    def frame(self, root, rows, columns):
        """A wall at 3 m in front of the camera: its distance grows towards the corners."""
        y, x = np.indices((rows, columns))
        pixels = 1024 / columns  # of the published width in one of these
        aside = ((x - (columns - 1) / 2) ** 2 + (y - (rows - 1) / 2) ** 2) * pixels**2
        distance = 3 * np.sqrt(1 + aside / 886.81**2)
        distance[100, 200] = np.nan
        images = root / "ai_001_001/images"
        write_picture(images / "scene_cam_00_final_preview/frame.0007.tonemap.jpg", picture(rows, columns))
        (images / "scene_cam_00_geometry_hdf5").mkdir()
        with h5py.File(images / "scene_cam_00_geometry_hdf5/frame.0007.depth_meters.hdf5", "w") as file:
            file.create_dataset("dataset", data=distance.astype(np.float16))
        return root

    @pytest.mark.parametrize("size", [(768, 1024), (384, 512), (240, 320)])
    def test_feature_distance_along_the_ray_becomes_depth_at_any_size(self, size, tmp_path):
        (sample,) = hypersim(self.frame(tmp_path, *size))
        self.assert_close(sample["depth"], torch.full((1, *size), 3.0), rtol=2e-3, atol=0)  # float16, and the hole
        assert (~sample["mask"]).nonzero().tolist() == [[0, 100, 200]]
        assert sample["name"] == "ai_001_001/cam_00/0007"

    def test_exception_a_crop(self, tmp_path):
        with pytest.raises(ValueError, match="must have sides of 4 : 3, got 512 rows x 512 columns"):
            hypersim(self.frame(tmp_path, 512, 512))[0]
