from __future__ import annotations

import kornia.augmentation as K
import pytest
import torch
from kornia.constants import DataKey

from kornia_tidy.augmentation import RandomTiDyOptics, SceneGeometry
from kornia_tidy.augmentation.scene_geometry import warped_entries
from tests.base import BaseTester
from tests.camera.pipeline_samples import camera, scene


class TestSceneGeometry(BaseTester):
    @pytest.mark.parametrize("batched", [True, False])
    def test_cardinality(self, batched):
        image, depth = scene(2)
        out = SceneGeometry(K.RandomCrop((32, 36)))(*((image, depth) if batched else (image[0], depth[0])))
        lead = (2,) if batched else ()
        assert out.image.shape == (*lead, 3, 32, 36)
        assert out.depth.shape == out.valid.shape == (*lead, 1, 32, 36)

    @pytest.mark.parametrize(
        "augmentations",
        [
            [K.RandomCrop((32, 41))],
            [K.RandomCrop((32, 41), cropping_mode="resample"), K.RandomHorizontalFlip(p=1.0)],
            [K.RandomVerticalFlip(p=0.5), K.RandomCrop((32, 41))],
            [K.RandomCrop((100, 140), pad_if_needed=True)],
            [K.RandomResizedCrop((32, 41))],
            [K.RandomCrop((32, 41)), K.Resize((64, 82))],
            [K.RandomAffine(20, (0.1, 0.1), (0.8, 1.2), p=1.0)],
            [K.RandomCrop((55, 71)), K.RandomPerspective(0.4, p=1.0)],
        ],
    )
    def test_feature_crops_lie_in_the_field_where_their_content_says(self, augmentations):
        """The image holds its own coordinates from the axis; in the crop they grow by those of a pixel."""
        y, x = torch.meshgrid(torch.arange(90.0).double(), torch.arange(121.0).double(), indexing="ij")
        image = torch.stack([y - 44.5 + 307, x - 60 - 420]).expand(3, 2, 90, 121)
        geometry = SceneGeometry(*augmentations)
        torch.manual_seed(1)
        out = geometry(image, torch.ones(3, 1, 90, 121)).image
        found = geometry.field_center(image, out, (307.0, -420.0))
        row, column = ((side - 1) // 2 for side in out.shape[-2:])
        here, beside = out[..., row, column], out[..., row - 1 : row + 2, column - 1 : column + 2]
        steps = torch.stack([beside[..., 2, 1] - beside[..., 0, 1], beside[..., 1, 2] - beside[..., 1, 0]], -1) / 2
        offset = torch.tensor([(side - 1) / 2 - (side - 1) // 2 for side in out.shape[-2:]])
        expected = torch.linalg.solve(steps, here[..., None])[..., 0] + offset
        self.assert_close(found.float(), expected, rtol=0, atol=2e-2)

    def test_exception_a_place_that_is_none(self):
        geometry, image = SceneGeometry(K.CenterCrop(8)), torch.rand(1, 3, 16, 16)
        out = geometry(image, torch.ones(1, 1, 16, 16)).image
        with pytest.raises(TypeError, match="field_center must be two numbers"):
            geometry.field_center(image, out, 5.0)

    def test_feature_a_flip_moves_image_depth_and_mask_alike(self):
        image, depth = scene(2)
        valid = depth > 1
        out = SceneGeometry(K.RandomHorizontalFlip(p=1.0))(image, depth, valid)
        assert torch.equal(out.image, image.flip(-1))
        assert torch.equal(out.valid, valid.flip(-1))
        assert torch.equal(out.depth[out.valid], depth.flip(-1)[out.valid])

    def test_feature_a_rotation_leaves_holes_that_are_masked_and_filled_with_depths_of_the_scene(self):
        image, depth = scene(2)
        out = SceneGeometry(K.RandomRotation((30.0, 30.0), p=1.0))(image, depth)
        assert 0.05 < (~out.valid).float().mean() < 0.4
        assert torch.isin(out.depth, depth).all()  # nearest: no depth between two things

    def test_feature_enlarged_scenes_are_nearer_where_that_is_asked_for(self):
        image, depth = scene(2)
        affine = K.RandomAffine(0.0, scale=(2.0, 2.0), p=1.0)
        plain = SceneGeometry(affine)
        as_it_is = plain(image, depth)
        scaled = SceneGeometry(affine, scale_depth=True)(image, depth, params=plain.params)
        self.assert_close(scaled.depth, as_it_is.depth / 2)

    def test_feature_scale_follows_a_resized_crop(self):
        image, depth = scene(1)
        crop = K.RandomResizedCrop((40, 48), scale=(0.25, 0.25), ratio=(1.2, 1.2), p=1.0)
        out = SceneGeometry(crop, scale_depth=True)(image, torch.full_like(depth, 3.0))
        magnification = (39 / 19 * 47 / 23) ** 0.5  # 20 x 24 pixels, from the first centre to the last
        self.assert_close(out.depth, torch.full_like(depth, 3.0 / magnification))

    def test_feature_other_masks_go_along(self):
        image, depth = scene(1)
        out = SceneGeometry(K.RandomHorizontalFlip(p=1.0))(image, depth, others={"mask_of_people": depth})
        assert torch.equal(out.others["mask_of_people"], depth.flip(-1))

    def test_exception_scale_of_a_perspective(self):
        image, depth = scene(1)
        with pytest.raises(ValueError, match="scale_depth needs a warp that enlarges all parts"):
            SceneGeometry(K.RandomPerspective(p=1.0), scale_depth=True)(image, depth.clamp(max=5))

    def test_exception_modules_that_would_warp_the_image_alone(self):
        for module in (torch.nn.AvgPool2d(2), K.RandomMixUpV2()):
            with pytest.raises(TypeError, match="augmentations of kornia that warp a mask with the image"):
                SceneGeometry(module)
        with pytest.raises(TypeError, match="is optics and belongs behind the geometry"):
            SceneGeometry(K.AugmentationSequential(RandomTiDyOptics(camera())))

    def test_exception_interpolated_depth(self):
        bilinear = {DataKey.MASK: {"resample": "bilinear", "align_corners": None}}
        chain = K.AugmentationSequential(K.RandomRotation(5.0), extra_args=bilinear)
        with pytest.raises(ValueError, match="nearest pixel, got extra_args with BILINEAR"):
            SceneGeometry(chain)

    def test_exception_an_entry_that_would_pass_unwarped(self):
        image, depth = scene(1)
        with pytest.raises(ValueError, match="call it 'mask_normals'"):
            warped_entries({"image": image, "depth": depth, "normals": image}, ("image", "depth"))

    def test_exception_depth_and_mask_that_do_not_fit(self):
        image, depth = scene(2)
        geometry = SceneGeometry(K.RandomHorizontalFlip(p=1.0))
        for other in (depth.expand(-1, 3, -1, -1), depth[..., :9], depth[[0, 1, 0]]):
            with pytest.raises(ValueError, match=r"depth must be one map \(1, 40, 48\) for each image"):
                geometry(image, other)
        with pytest.raises(ValueError, match=r"valid must have the depth's shape \(2, 1, 40, 48\), got \(3,\)"):
            geometry(image, depth, valid=torch.ones(3))
