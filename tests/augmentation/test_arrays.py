"""Captures and reconstructions of arrays: the same pixels as tensors give, in each layout, type and colour order."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb
from safetensors.torch import save_file

import kornia_tidy
from kornia_tidy import PixelwiseMask, SensorNoise, TiDyOptics
from kornia_tidy.arrays import depth_tensor, image_tensor, like_image
from kornia_tidy.data import read_rgbd, to_opencv
from kornia_tidy.reconstruction.camera_system import any_camera_system
from kornia_tidy.reconstruction.light_head import LightHead, reconstruct_light
from kornia_tidy.reconstruction.pretrained import load_pretrained
from kornia_tidy.reconstruction.trained import closed_form_bank
from tests.base import BaseTester

MOST = {"uint8": 255, "uint16": 65535, "float32": 1}


def picture(dtype, *shape, seed=0):
    values = np.random.default_rng(seed).random(shape)
    return (values * MOST[dtype]).astype(dtype)


@pytest.fixture(scope="module")
def optics():
    return TiDyOptics(PixelwiseMask(2, generator=torch.Generator().manual_seed(1)), sensor=None, fidelity="draft")


@pytest.fixture(scope="module")
def head():
    return LightHead(load_pretrained("joint-uncertain"))


class TestSimulate(BaseTester):
    @pytest.mark.parametrize("kind", MOST)
    def test_smoke(self, kind, optics):
        """Every type of depth that files and cameras give, for every type of image."""
        image = picture(kind, 24, 32, 3)
        depths = {"uint16": 0.001, "int32": 0.001, "float16": None, "float32": None, "float64": None}
        for name, scale in depths.items():
            depth = np.full((24, 32), 700 if scale else 0.7, name)
            found = kornia_tidy.simulate(image, depth, scale, optics=optics)
            assert (found.shape, found.dtype) == (image.shape, image.dtype)
            assert np.isfinite(found).all()

    @pytest.mark.parametrize("kind", MOST)
    @pytest.mark.parametrize("color", ["bgr", "rgb"])
    def test_feature_the_capture_of_the_same_tensors(self, kind, color, optics):
        """Within the rounding to the data type and of the division to [0, 1]."""
        image, depth = picture(kind, 24, 32, 3), picture("float32", 24, 32, seed=1) + 0.5
        rgb = image[..., ::-1] if color == "bgr" else image
        tensor = torch.from_numpy(np.ascontiguousarray(rgb.astype(np.float64) / MOST[kind])).permute(2, 0, 1)
        expected = optics(tensor.float(), torch.from_numpy(depth)[None]).detach().permute(1, 2, 0).numpy()
        found = kornia_tidy.simulate(image, depth, optics=optics, color=color)
        assert found.dtype == image.dtype
        assert found.flags.c_contiguous
        found = (found[..., ::-1] if color == "bgr" else found) / MOST[kind]
        assert np.abs(found - expected).max() <= (0.5 / MOST[kind] if MOST[kind] > 1 else 0) + 1e-5

    @pytest.mark.parametrize("shape", [(24, 32), (24, 32, 1), (24, 32, 3), (2, 24, 32, 1), (2, 24, 32, 3)])
    def test_cardinality(self, shape, optics):
        size = shape[:3] if len(shape) == 4 else shape[:2]
        depth = np.full(size, 0.7, np.float32)
        for one in (depth, depth[..., None]):
            assert kornia_tidy.simulate(picture("uint8", *shape), one, optics=optics).shape == shape

    def test_feature_a_batch_is_its_images(self, optics):
        image, depth = picture("uint16", 2, 24, 32, 3), picture("float32", 2, 24, 32) + 0.4
        found = kornia_tidy.simulate(image, depth, optics=optics)
        for i in range(2):
            one = kornia_tidy.simulate(image[i], depth[i], optics=optics).astype(int)
            assert np.abs(found[i] - one).max() <= 1

    def test_feature_files_of_opencv_and_the_readers_agree(self, tmp_path, optics):
        bgr, millimetres = picture("uint8", 24, 32, 3), (1000 * (picture("float32", 24, 32) + 0.5)).astype(np.uint16)
        millimetres[4:9, 5:20] = 0  # unknown
        cv2.imwrite(str(tmp_path / "a.png"), bgr)
        cv2.imwrite(str(tmp_path / "d.png"), millimetres)
        scene = read_rgbd(tmp_path / "a.png", tmp_path / "d.png", scale=0.001)
        expected = optics(scene.image, scene.depth).detach().numpy()[::-1].transpose(1, 2, 0)
        read = cv2.imread(str(tmp_path / "a.png")), cv2.imread(str(tmp_path / "d.png"), cv2.IMREAD_UNCHANGED)
        found = kornia_tidy.simulate(*read, depth_scale=0.001, optics=optics, holes="fill")
        assert np.abs(found / 255 - expected).max() <= 0.5 / 255 + 1e-5

    def test_feature_the_same_masks_in_every_call_and_noise_by_seed(self):
        image, depth = picture("uint16", 40, 48, 3), np.full((40, 48), 0.4)
        first, second, other = (kornia_tidy.simulate(image, depth, seed=seed) for seed in (0, 0, 1))
        told = TiDyOptics(PixelwiseMask(5, generator=torch.Generator().manual_seed(0)))
        assert (first == kornia_tidy.simulate(image, depth, optics=told, seed=0)).all()
        assert (first == second).all()
        assert (first == kornia_tidy.simulate(image, depth, torch.tensor(1.0), seed=np.int64(0))).all()
        assert (first == kornia_tidy.simulate(image, depth.astype(np.longdouble), seed=0)).all()
        assert (first != other).any()
        assert np.abs(first.astype(int) - other).max() < 0.2 * 65535  # noise of 0.01 in linear light, not other masks

    def test_feature_float_light_above_one_where_the_camera_is_linear(self):
        optics = TiDyOptics(PixelwiseMask(1), sensor=None, fidelity="draft", color_space="linear")
        image = np.full((24, 32, 3), 4.0, np.float32)
        found = kornia_tidy.simulate(image, np.full((24, 32), 0.6), optics=optics)
        assert found.max() == pytest.approx(4.0, rel=1e-3)

    @pytest.mark.parametrize(
        ("change", "error", "sentence"),
        [
            ({"image": np.zeros((4, 5, 3))}, TypeError, "uint8, uint16 or float32, got float64"),
            ({"image": [[0]]}, TypeError, "image must be an array of .*, got a list"),
            ({"image": np.zeros((4, 5, 4), np.uint8)}, ValueError, r"got \(4, 5, 4\): drop alpha"),
            ({"image": np.zeros((3, 4, 5), np.uint8)}, ValueError, r"channels come last, np.moveaxis\(image, 0, -1\)"),
            ({"image": np.zeros((7, 4, 5), np.uint8)}, ValueError, r"batch of grey images is image\[..., None\]"),
            ({"image": np.zeros((0, 5, 3), np.uint8)}, ValueError, r"image must have shape .*, got \(0, 5, 3\)"),
            ({"image": np.full((4, 5, 3), 200, np.float32)}, ValueError, r"in \[0, 1\], found 200 to 200: divide"),
            ({"image": np.full((4, 5, 3), np.nan, np.float32)}, ValueError, r"in \[0, 1\], found nan"),
            ({"depth": np.ones((4, 5), np.uint16)}, ValueError, "depth of uint16 needs depth_scale, .* such as 0.001"),
            ({"depth": np.ones((4, 5), bool)}, TypeError, "depth must be an array of integers or floats, got bool"),
            ({"depth": -np.ones((4, 5))}, ValueError, "depth must be positive metres, got -1.0: fill holes with"),
            ({"depth": np.zeros((4, 5)), "holes": "fill"}, ValueError, "must be known at one pixel or more"),
            ({"depth": np.zeros((4, 5))}, ValueError, r"depth must be positive metres, got 0\.0: fill holes with"),
            ({"depth": np.ones((5, 4))}, ValueError, r"rows, columns and batch of the image \(4, 5, 3\), got \(5, 4\)"),
            ({"depth": np.ones((4, 5, 2, 2))}, ValueError, r"depth must have shape .*, got \(4, 5, 2, 2\)"),
            ({"depth_scale": 0.0}, ValueError, "depth_scale must be positive"),
            ({"depth_scale": np.array([1.0, 2.0])}, TypeError, "depth_scale must be a number in metres per unit, got"),
            ({"seed": 1.5}, TypeError, "seed must be a whole number, got the number 1.5"),
            ({"color": "BGR"}, ValueError, "color must be one of 'bgr', 'rgb', got 'BGR'"),
            ({"optics": "tidy-5"}, TypeError, "optics must be a camera such as TiDyOptics.., got 'tidy-5'"),
        ],
    )
    def test_exception(self, change, error, sentence):
        given = {"image": np.zeros((4, 5, 3), np.uint8), "depth": np.ones((4, 5)), **change}
        with pytest.raises(error, match=sentence) as raised:
            kornia_tidy.simulate(**given)
        assert "\n" not in str(raised.value)


class TestReconstruct(BaseTester):
    @pytest.mark.parametrize("kind", MOST)
    def test_feature_the_images_of_linear_light(self, kind, head):
        capture = picture(kind, 2, 32, 48, 3)
        image, depth = kornia_tidy.reconstruct(capture, head)
        assert image.dtype == capture.dtype
        assert image.shape == capture.shape
        assert depth.shape == (2, 32, 48)
        given = capture[1] if kind != "float32" else np.rint(65535 * capture[1]).astype(np.uint16)
        light = rgb_to_linear_rgb(image_tensor(given[..., ::-1]))
        found, metres, *_ = reconstruct_light(head, light)
        expected, metres = to_opencv(found, given.dtype), metres[0].numpy()
        most = np.iinfo(given.dtype).max
        assert np.abs(image[1] / MOST[kind] - expected / most).max() < 1e-3
        assert np.allclose(1 / depth[1], 1 / metres, atol=1e-3)

    def test_cardinality(self, head):
        for shape, found in (((32, 48), (32, 48, 3)), ((32, 48, 1), (32, 48, 3)), ((1, 32, 48, 1), (1, 32, 48, 3))):
            image, depth = kornia_tidy.reconstruct(picture("uint8", *shape), head)
            assert image.shape == found
            assert depth.shape == found[:-1]

    def test_feature_colours_by_name(self, head):
        capture = picture("uint16", 32, 48, 3)
        bgr = kornia_tidy.reconstruct(capture, head, color="bgr").image
        rgb = kornia_tidy.reconstruct(np.ascontiguousarray(capture[..., ::-1]), head, color="rgb").image
        assert (bgr == rgb[..., ::-1]).all()

    @pytest.mark.takes_seconds
    def test_feature_a_system_without_depth(self):
        image, depth = kornia_tidy.reconstruct(picture("uint8", 32, 48, 3), load_pretrained("edof-flat"))
        assert depth is None
        assert image.shape == (32, 48, 3)

    def test_exception(self, head):
        with pytest.raises(FileNotFoundError, match=r"there is no folder joint-9, .* shipped systems .* the camera"):
            kornia_tidy.reconstruct(picture("uint8", 8, 8, 3), "joint-9")
        with pytest.raises(ValueError, match=r"captures must be one or more, got shape \(0, 8, 8, 3\)"):
            kornia_tidy.reconstruct(picture("uint8", 0, 8, 8, 3), head)
        with pytest.raises(TypeError, match="memory_budget must be a number in bytes, got '1GB'"):
            kornia_tidy.reconstruct(picture("uint8", 8, 8, 3), head, memory_budget="1GB")
        with pytest.raises(ValueError, match=r"image must have shape .*, got \(8, 8, 4\): drop alpha"):
            kornia_tidy.reconstruct(picture("uint8", 8, 8, 4), head)
        with pytest.raises(TypeError, match="system must be a TiDyOptics, a PSFBank, a TrainedSystem"):
            kornia_tidy.reconstruct(picture("uint8", 8, 8, 3), 5)


class TestConversion(BaseTester):
    @pytest.mark.parametrize("kind", ["uint8", "uint16"])
    def test_feature_every_number_comes_back(self, kind):
        numbers = np.arange(MOST[kind] + 1, dtype=kind).reshape(2, -1)
        assert (like_image(image_tensor(numbers), numbers) == numbers).all()

    @pytest.mark.parametrize("kind", [np.uint16, np.int32, np.float32, np.float64])
    @pytest.mark.parametrize("beneath", [0, 9, 65000, np.nan, -1, 1e20])
    def test_feature_masked_depth_is_a_hole_whatever_lies_beneath_the_mask(self, kind, beneath):
        """As rasterio and netCDF4 return unknown values; the fill value is another number again."""
        if not np.issubdtype(kind, np.floating) and not 0 <= beneath <= 65000:
            beneath = np.iinfo(kind).max
        values = np.array([[500, 0, 2000], [500, 500, 2000]], np.float64)
        values[0, 1] = beneath
        depth = np.ma.masked_array(values.astype(kind), mask=[[0, 1, 0], [0, 0, 0]], fill_value=777)
        expected = torch.tensor([[[0.5, 0.0, 2.0], [0.5, 0.5, 2.0]]])
        self.assert_close(depth_tensor(depth, 0.001).float(), expected)
        self.assert_close(depth_tensor(np.ma.masked_array(expected[0].numpy())), expected)  # nothing is masked

    def test_feature_masked_images_are_divided_whole_or_refused(self):
        image = np.ma.masked_array(picture("uint8", 4, 5, 3))
        depth = np.ones((4, 5))
        assert torch.equal(image_tensor(image), image_tensor(image.data))
        image.mask = np.indices(image.shape)[1] == 2
        for name, call in (
            ("image", lambda: kornia_tidy.simulate(image, depth)),
            ("capture", lambda: kornia_tidy.reconstruct(image)),
        ):
            with pytest.raises(ValueError, match=rf"{name} must be known at every pixel, and 12 of its 60 values are"):
                call()

    def test_feature_the_names_are_there_and_others_are_not(self):
        assert {"simulate", "reconstruct"} <= set(kornia_tidy.__all__)
        with pytest.raises(AttributeError, match="has no attribute 'simulat'"):
            _ = kornia_tidy.simulat


class TestBehindALens(BaseTester):
    def test_feature_arrays_are_taken_through_a_lens_at_their_place(self):
        image = np.random.default_rng(0).random((40, 36, 3), np.float32)
        depth = np.full((40, 36), 0.8, np.float32)
        seen = kornia_tidy.simulate(image, depth, lens="single-50mm", field_center=(200.0, -100.0), color="rgb", seed=1)
        masks = PixelwiseMask(5, generator=torch.Generator().manual_seed(0))
        optics = TiDyOptics(masks, lens="single-50mm", field_center=(200.0, -100.0))
        pixels, metres = torch.from_numpy(image).movedim(-1, 0), torch.from_numpy(depth)[None]
        expected = optics(pixels, metres, generator=torch.Generator().manual_seed(1)).detach()
        self.assert_close(torch.from_numpy(seen).movedim(-1, 0), expected, rtol=0, atol=1e-4)
        with pytest.raises(ValueError, match="optics has its own lens"):
            kornia_tidy.simulate(image, depth, optics=TiDyOptics(), lens="single-50mm")


class TestReconstructAnyCamera(BaseTester):
    def test_feature_a_camera_its_file_and_its_system_give_the_same_picture(self, tmp_path):
        optics = TiDyOptics(PixelwiseMask(2, generator=torch.Generator().manual_seed(1)), fidelity="draft")
        save_file(optics.state_dict(), path := tmp_path / "camera.safetensors")
        capture = (255 * np.random.default_rng(0).random((48, 64, 3))).astype(np.uint8)
        system = any_camera_system(optics)
        images = [kornia_tidy.reconstruct(capture, camera).image for camera in (optics, path, system)]
        assert all(np.array_equal(image, images[0]) for image in images)
        assert images[0].shape == capture.shape
        assert not np.array_equal(kornia_tidy.reconstruct(capture, TiDyOptics(fidelity="draft")).image, images[0])

    def test_feature_the_psfs_of_a_camera_are_enough(self):
        """They give what the camera gives: of even grey the noise is known, and is measured."""
        optics = TiDyOptics(fidelity="draft", sensor=SensorNoise(0.02))
        light = 0.4 + 0.02 * torch.randn(3, 128, 128, generator=torch.Generator().manual_seed(0))
        capture = linear_rgb_to_rgb(light).movedim(0, -1).numpy()
        told = kornia_tidy.reconstruct(capture, optics).image
        found = kornia_tidy.reconstruct(capture, closed_form_bank(optics, 7)).image
        assert float(np.square(found - told).mean()) < 0.05 * float(np.square(capture - told).mean())
        with pytest.warns(UserWarning, match=r"capture: its noise is 0.02.*, 10 times the stated"):
            kornia_tidy.reconstruct(capture, TiDyOptics(fidelity="draft", sensor=SensorNoise(0.002)))
