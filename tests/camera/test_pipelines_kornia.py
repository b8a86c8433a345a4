from __future__ import annotations

import kornia.augmentation as K
import pytest
import torch
from torch import Tensor, nn

from kornia_tidy import TiDyOptics
from tests.base import BaseTester
from tests.camera.pipeline_samples import camera, scene


class Pipeline(nn.Module):
    """What people write: warp image and depth together, take the picture, change its colours."""

    def __init__(self, geometry: nn.Module, optics: TiDyOptics, photometry: nn.Module) -> None:
        super().__init__()
        self.geometry, self.optics, self.photometry = geometry, optics, photometry

    def forward(self, sample: dict[str, Tensor]) -> dict[str, Tensor]:
        sample = self.optics(self.geometry(sample))
        return {**sample, "image": self.photometry(sample["image"])}


def flip_and_crop(**options: object) -> K.AugmentationSequential:
    return K.AugmentationSequential(K.RandomHorizontalFlip(p=1.0), K.RandomCrop((32, 36), p=1.0), **options)


def crops(geometry: K.AugmentationSequential, tensor: Tensor) -> Tensor:
    """Flip and crop by slicing, at the corners that kornia drew."""
    corners = geometry._params[1].data["src"][:, 0].long().tolist()
    flipped = tensor.flip(-1)
    return torch.stack(
        [x[:, top : top + 32, left : left + 36] for x, (left, top) in zip(flipped, corners, strict=True)]
    )


class TestAfterGeometry(BaseTester):
    @pytest.mark.parametrize("form", ["positional", "mapping"])
    def test_feature_image_and_depth_are_warped_together(self, form, device):
        optics, (image, depth) = camera(sensor=None).to(device), (x.to(device) for x in scene(3))
        if form == "positional":
            geometry = flip_and_crop(data_keys=["image", "mask"])
            coded = optics(tuple(geometry(image, depth)))[0]
        else:
            geometry = flip_and_crop(data_keys=None)
            coded = optics(geometry({"image": image, "mask_depth": depth}))["image"]
        self.assert_close(coded, optics(crops(geometry, image), crops(geometry, depth)))

    def test_feature_depth_arrives_in_float32_and_exact(self):
        image, depth = scene()
        geometry = flip_and_crop(data_keys=None)
        out = camera()(geometry({"image": image, "mask_depth": depth}))
        assert out["mask_depth"].dtype == torch.float32
        assert torch.equal(out["mask_depth"], crops(geometry, depth))  # the sky stays at infinity

    def test_feature_a_quarter_turn_before_the_optics(self):
        image, depth = scene(1, height=40, width=40)
        turn = K.AugmentationSequential(K.RandomRotation((90.0, 90.0), p=1.0), data_keys=["image", "mask"])
        turned = turn(image, depth.nan_to_num(posinf=5.0))
        expected = (torch.rot90(x, 1, (-2, -1)) for x in (image, depth.nan_to_num(posinf=5.0)))
        optics = camera(sensor=None)
        self.assert_close(optics(tuple(turned))[0], optics(*expected), atol=1e-4)

    def test_exception_the_zeros_that_a_rotation_leaves_in_depth_are_refused(self):
        turn = K.AugmentationSequential(K.RandomRotation((30.0, 30.0), p=1.0), data_keys=None)
        image, depth = scene()
        sample = turn({"image": image, "mask_depth": depth.nan_to_num(posinf=5.0)})
        with pytest.raises(ValueError, match=r"depth must be positive metres, got 0\.0"):
            camera()(sample)


class TestBeforePhotometry(BaseTester):
    def test_feature_the_pipeline_is_the_chain_of_its_parts_done_by_hand(self):
        jiggle = K.AugmentationSequential(K.ColorJiggle(0.2, 0.2, 0.2, 0.1, p=1.0), data_keys=["image"])
        geometry, optics, (image, depth) = flip_and_crop(data_keys=None), camera(), scene()
        torch.manual_seed(4)
        out = Pipeline(geometry, optics, jiggle)({"image": image, "mask_depth": depth})
        # The colour draws come last, so the camera's noise is the first draw after the crops'.
        torch.manual_seed(4)
        flip_and_crop(data_keys=None)({"image": image, "mask_depth": depth})
        params = optics.draw(crops(geometry, image))
        coded = optics(crops(geometry, image), crops(geometry, depth), params=params)
        self.assert_close(out["image"], jiggle(coded, params=jiggle._params))
        self.assert_close(out["all_in_focus"], crops(geometry, image))

    def test_feature_order_matters_so_the_camera_is_not_moved_behind_the_colours(self):
        image, depth = scene()
        jiggle, optics = K.ColorJiggle(contrast=(0.3, 0.3), p=1.0), camera(sensor=None)
        after = jiggle(optics(image, depth))
        assert (after - optics(jiggle(image, params=jiggle._params), depth)).abs().max() > 1e-3

    def test_feature_gradients_reach_the_masks_through_the_colours(self):
        jiggle = K.ColorJiggle(0.2, 0.2, 0.2, 0.1, p=1.0)
        pipeline, (image, depth) = Pipeline(flip_and_crop(data_keys=None), camera(), jiggle), scene()
        pipeline({"image": image, "mask_depth": depth})["image"].square().mean().backward()
        gradient = pipeline.optics.masks.phase.grad
        assert gradient.isfinite().all()
        assert (gradient.abs().amax((1, 2)) > 0).all()
