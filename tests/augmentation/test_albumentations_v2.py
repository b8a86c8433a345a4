from __future__ import annotations

import pytest

from tests.augmentation.optional import need

need("albumentations")

import albumentations as A  # noqa: E402
import numpy as np  # noqa: E402
import torch  # noqa: E402

from kornia_tidy.arrays import depth_tensor, image_tensor  # noqa: E402
from kornia_tidy.augmentation import RandomTiDyOptics  # noqa: E402
from kornia_tidy.augmentation.albumentations_v2 import OpticsTransform  # noqa: E402
from tests.base import BaseTester  # noqa: E402
from tests.camera.pipeline_samples import camera, scene  # noqa: E402

DEPTH = {"additional_targets": {"depth": "mask"}}
FILLED = {"additional_targets": {"depth": "mask", "valid": "mask"}}


def arrays(kind: type = np.float32) -> dict[str, np.ndarray]:
    image, depth = scene(1)
    image = image[0].permute(1, 2, 0).numpy()
    return {"image": (image * 255).astype(np.uint8) if kind is np.uint8 else image, "depth": depth[0, 0].numpy()}


def captured(optics: torch.nn.Module, image: np.ndarray, depth: np.ndarray) -> np.ndarray:
    return optics(image_tensor(image), depth_tensor(depth)).permute(1, 2, 0).detach().numpy()


class TestOpticsTransform(BaseTester):
    @pytest.mark.parametrize("shape", [(40, 48), (40, 48, 1), (40, 48, 3)])
    @pytest.mark.parametrize("axis", [False, True])
    def test_cardinality(self, shape, axis):
        image, depth = np.random.default_rng(0).random(shape, np.float32), np.ones((40, 48, 1)[: 2 + axis], np.float32)
        out = A.Compose([A.HorizontalFlip(p=1.0), OpticsTransform(camera())], **DEPTH)(image=image, depth=depth)
        assert out["image"].shape == image.shape
        assert out["depth"].shape[:2] == (40, 48)

    def test_feature_flip_optics_crop_equals_the_manual_chain(self):
        optics, given = camera(sensor=None), arrays()
        chain = A.Compose([A.HorizontalFlip(p=1.0), OpticsTransform(optics), A.CenterCrop(20, 24)], **DEPTH)
        out = chain(**given)
        flipped = {name: array[:, ::-1].copy() for name, array in given.items()}
        expected = captured(optics, **flipped)[10:30, 12:36]
        assert np.abs(out["image"] - expected).max() < 1e-6
        assert np.array_equal(out["depth"], flipped["depth"][10:30, 12:36])

    def test_feature_eight_bit_images_stay_eight_bit(self):
        optics, given = camera(sensor=None), arrays(np.uint8)
        out = A.Compose([OpticsTransform(optics)], **DEPTH)(**given)["image"]
        assert out.dtype == np.uint8
        assert np.abs(out / 255 - captured(optics, **given)).max() <= 0.5001 / 255

    def test_feature_noise_follows_the_seed_of_compose_and_leaves_torch_alone(self):
        given, optics = arrays(), RandomTiDyOptics(camera(), noise_level=(0, 0.1), p=1.0)
        before = torch.get_rng_state()
        outs = [A.Compose([OpticsTransform(optics)], seed=seed, **DEPTH)(**given)["image"] for seed in (1, 1, 2)]
        assert np.array_equal(outs[0], outs[1])
        assert not np.array_equal(outs[0], outs[2])
        assert torch.equal(torch.get_rng_state(), before)

    def test_feature_masks_boxes_and_other_entries_pass(self):
        given = {**arrays(), "mask": np.eye(40, 48, dtype=np.uint8), "label": 3}
        given["masks"], points = np.stack([given["mask"]] * 2), np.array([[3.5, 4.5]], np.float32)
        boxes = np.array([[3, 4, 10, 12]], np.float32)
        kinds = {
            "bbox_params": A.BboxParams("pascal_voc", label_fields=["kinds"]),
            "keypoint_params": A.KeypointParams("xy"),
        }
        transform = OpticsTransform(camera())
        out = A.Compose([transform], **kinds, **DEPTH)(**given, bboxes=boxes, kinds=[1], keypoints=points)
        assert {"image", "mask", "masks", "bboxes", "keypoints"} <= set(transform.targets)
        assert np.array_equal(out["mask"], given["mask"])
        assert np.array_equal(out["masks"], given["masks"])
        assert np.allclose(out["keypoints"], points)
        assert np.allclose(out["bboxes"], boxes)
        assert out["label"] == 3

    def test_feature_the_mask_of_holes_is_moved_beyond_the_image_too(self):
        """Whether or not the picture is taken, so that a data loader finds one set of keys."""
        given = arrays()
        given["depth"][8:14, 20:30] = 0
        for p in (0.0, 1.0):
            chain = [OpticsTransform(camera(), p=p, holes="fill"), A.HorizontalFlip(p=1.0), A.Rotate((90, 90), p=1.0)]
            out = A.Compose(chain, **FILLED)(**given)
            turned = A.Compose(chain[1:], **DEPTH)(**given)["depth"]
            assert np.array_equal(out["valid"], (turned > 0).astype(np.uint8))

    def test_exception_depth_that_other_transforms_do_not_warp(self):
        chain = A.Compose([A.HorizontalFlip(p=1.0), OpticsTransform(camera(), p=0.01)])
        with pytest.raises(ValueError, match="depth passes through other transforms unwarped: tell them"):
            chain(**arrays())
        chain = A.Compose([OpticsTransform(camera(), holes="fill"), A.HorizontalFlip(p=1.0)], **DEPTH)
        with pytest.raises(ValueError, match=r"valid passes .* additional_targets={'depth': 'mask', 'valid': 'mask'}"):
            chain(**arrays())

    def test_exception_interpolated_masks(self):
        chain = A.Compose([A.Rotate(), OpticsTransform(camera())], mask_interpolation=1, **DEPTH)
        with pytest.raises(ValueError, match="got a Compose with another mask_interpolation"):
            chain(**arrays())

    @pytest.mark.parametrize("name", ["image", "depth"])
    def test_exception_masked_values(self, name):
        given = arrays()
        given[name] = np.ma.masked_greater(given[name], np.median(given[name]))
        with pytest.raises(ValueError, match=rf"{name} must be known .* masked: fill them .* {name}\.filled\(0\)"):
            A.Compose([OpticsTransform(camera())], **DEPTH)(**given)

    def test_exception_no_depth(self):
        with pytest.raises(ValueError, match=r"missing keys: {'depth'}"):
            A.Compose([OpticsTransform(camera())], **DEPTH)(image=arrays()["image"])
        with pytest.raises(ValueError, match=r"missing keys: {'depth'}"):
            A.Compose([OpticsTransform(camera(), holes="fill")], **FILLED)(image=arrays()["image"])
        with pytest.raises(ValueError, match="border 'valid' crops the image"):
            OpticsTransform(camera(border="valid"))
