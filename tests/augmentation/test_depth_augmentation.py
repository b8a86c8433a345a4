from __future__ import annotations

import kornia.augmentation as K
import pytest
import torch
from torch import Tensor, nn

from kornia_tidy.augmentation import RandomTiDyOptics, bound_depth
from tests.base import BaseTester
from tests.camera.pipeline_samples import camera, scene


def crops(geometry: K.AugmentationSequential, tensor: Tensor) -> Tensor:
    """Flip and crop by slicing, at the corners that kornia drew."""
    corners = geometry._params[1].data["src"][:, 0].long().tolist()
    flipped = tensor.flip(-1)
    return torch.stack(
        [x[:, top : top + 32, left : left + 36] for x, (left, top) in zip(flipped, corners, strict=True)]
    )


def augmentation(**options: object) -> RandomTiDyOptics:
    return RandomTiDyOptics(camera(sensor=None), **{"p": 1.0, **options})


def chain(optics: RandomTiDyOptics, **options: object) -> K.AugmentationSequential:
    return K.AugmentationSequential(
        K.RandomHorizontalFlip(p=1.0), optics.depth_tap, optics, K.RandomCrop((32, 36), p=1.0), **options
    )


class TestInAugmentationSequential(BaseTester):
    @pytest.mark.parametrize("channels", [1, 3])
    @pytest.mark.parametrize("keepdim", [True, False])
    @pytest.mark.parametrize("count", [1, 2, None])
    def test_cardinality(self, count, keepdim, channels):
        image, depth = scene(count or 1, channels) if count else (x[0] for x in scene(1, channels))
        sequence = chain(augmentation(keepdim=keepdim), data_keys=["input", "mask"], keepdim=keepdim)
        coded, warped = sequence(image, depth)
        lead = () if count is None and keepdim else (count or 1,)
        assert coded.shape == (*lead, channels, 32, 36)
        assert warped.shape == (*lead, 1, 32, 36)

    @pytest.mark.parametrize("keys", [("image", "mask_depth"), ("mask_depth", "image"), ("input", "mask"), None])
    def test_feature_flip_optics_crop_equals_the_manual_chain(self, keys):
        """The image to 1e-6, as the issue asks; depth exactly, since nothing computes with it."""
        optics, (image, depth) = augmentation(), scene(3)
        if keys is None:
            sequence = chain(optics, data_keys=["input", "mask"])
            coded, out = sequence(image, depth)
        else:
            sequence, given = chain(optics, data_keys=None), {"image": image, "input": image}
            result = sequence({key: given.get(key, depth) for key in keys})
            coded, out = (result[key] for key in sorted(keys, key=lambda key: "mask" in key))
        corners = _Corners(sequence)
        expected = crops(corners, camera_of(optics)(image.flip(-1), depth.flip(-1)).flip(-1))
        self.assert_close(coded, expected, rtol=0, atol=1e-6)
        assert torch.equal(out, crops(corners, depth))

    def test_feature_of_several_masks_the_named_one_is_the_depth(self):
        optics, (image, depth) = augmentation(), scene(2)
        sequence = K.AugmentationSequential(optics.depth_tap, optics, data_keys=["input", "mask", "mask"])
        with pytest.raises(ValueError, match="2 masks reach RandomTiDyOptics: tell which of them is the depth"):
            sequence(image, torch.ones_like(depth), depth)
        optics.depth_tap.mask = 1
        self.assert_close(sequence(image, torch.ones_like(depth), depth)[0], camera_of(optics)(image, depth))

    @pytest.mark.parametrize("mask", [1, 5, -1])
    def test_exception_a_mask_that_is_not_there(self, mask):
        optics, (image, depth) = augmentation(), scene(2)
        optics.depth_tap.mask = mask
        sequence = K.AugmentationSequential(optics.depth_tap, optics, data_keys=["input", "mask"])
        with pytest.raises(ValueError, match=rf"depth_tap.mask must be from 0 to 0 for 1 masks, got {mask}"):
            sequence(image, depth)

    def test_exception_a_depth_that_passes_unwarped(self):
        optics, (image, depth) = augmentation(), scene(2)
        with pytest.raises(ValueError, match=r"under the key 'mask' or 'mask_depth' \('depth' passes unwarped\)"):
            chain(optics, data_keys=None)({"image": image, "depth": depth})

    @pytest.mark.parametrize("between", [K.RandomHorizontalFlip(p=1.0), K.RandomHorizontalFlip(p=0.0), K.RandomGamma()])
    def test_exception_a_child_between_tap_and_optics(self, between):
        optics = augmentation()
        sequence = K.AugmentationSequential(optics.depth_tap, between, optics, data_keys=["input", "mask"])
        with pytest.raises(ValueError, match="must directly follow its depth_tap"):
            sequence(*scene(2))

    def test_exception_a_random_order_never_misaligns(self):
        """Where the children come in another order than tap, optics, the call ends in an error."""
        optics, (image, depth) = augmentation(), scene(2)
        flip = K.RandomHorizontalFlip(p=1.0)
        sequence = K.AugmentationSequential(flip, optics.depth_tap, optics, data_keys=["input", "mask"], random_apply=3)
        straight, flipped = camera_of(optics)(image, depth), camera_of(optics)(image.flip(-1), depth.flip(-1))
        good = (straight.flip(-1), flipped)
        outcomes = set()
        for _ in range(30):
            try:
                coded, out = sequence(image, depth)
            except ValueError:
                outcomes.add("refused")
            else:
                outcomes.add("taken")
                assert torch.equal(out, depth.flip(-1))
                assert any(torch.allclose(coded, other, atol=1e-6) for other in good)
        assert outcomes == {"refused", "taken"}

    def test_exception_an_image_whose_memory_is_used_again(self):
        """A tap whose optics were left out must not hand its depth to the next image."""
        optics, (image, depth) = augmentation(), scene(2)
        K.AugmentationSequential(optics.depth_tap, data_keys=["input", "mask"])(image, depth)
        image.copy_(scene(2, seed=9)[0])
        with pytest.raises(ValueError, match="must directly follow its depth_tap"):
            K.AugmentationSequential(optics, data_keys=["input"])(image)

    def test_exception_depth_in_half_precision(self):
        optics, (image, depth) = augmentation(), scene(2)
        with pytest.raises(ValueError, match=r"depth reaches RandomTiDyOptics in torch.float16, since the container"):
            chain(optics, data_keys=["input", "mask"])(image.half(), depth)

    def test_exception_nested_in_a_container_that_gives_the_image_first(self):
        optics = augmentation()
        sequence = K.AugmentationSequential(K.ImageSequential(optics.depth_tap, optics), data_keys=["input", "mask"])
        with pytest.raises(ValueError, match="RandomTiDyOptics got no depth"):
            sequence(*scene(2))


class TestBoundDepth(BaseTester):
    @pytest.mark.parametrize("maps", ["own", "one", "without a batch"])
    def test_cardinality(self, maps):
        image, depth = scene(3)
        given = {"own": depth, "one": depth[:1], "without a batch": depth[0]}[maps]
        with bound_depth(sequence := K.ImageSequential(augmentation()), given):
            assert sequence(image).shape == image.shape

    def test_feature_image_sequential(self):
        optics, (image, depth) = augmentation(), scene(2)
        with bound_depth(sequence := K.ImageSequential(nn.Identity(), optics), depth):
            coded = sequence(image)
        self.assert_close(coded, camera_of(optics)(image, depth))
        with pytest.raises(ValueError, match="got no depth"):  # it is unbound again
            sequence(image)

    @pytest.mark.parametrize("data_format", ["BTCHW", "BCTHW"])
    def test_feature_frame_by_frame_in_a_video(self, data_format):
        optics, (image, depth) = augmentation(), scene(6)
        frames = [x.view(2, 3, *x.shape[1:]) for x in (image, depth)]
        frames = [x.transpose(1, 2) if data_format == "BCTHW" else x for x in frames]
        sequence = K.VideoSequential(optics, data_format=data_format, same_on_frame=True)
        with bound_depth(sequence, frames[1]):
            coded = sequence(frames[0])
        coded = coded.transpose(1, 2) if data_format == "BCTHW" else coded
        self.assert_close(coded.flatten(0, 1), camera_of(optics)(image, depth))

    @pytest.mark.parametrize("after", [False, True])
    @pytest.mark.parametrize("other", [K.RandomRotation(5.0), K.RandomMixUpV2(), nn.AvgPool2d(3, 1, 1)])
    def test_exception_children_that_may_move_pixels(self, other, after):
        children = (augmentation(), other) if after else (other, augmentation())
        with (
            pytest.raises(ValueError, match="may move pixels, and a bound depth does not move with them"),
            bound_depth(K.ImageSequential(*children), scene(2)[1]),
        ):
            pass

    def test_exception_patches_and_containers_without_optics(self):
        patches = K.PatchSequential(augmentation(), grid_size=(2, 2), patchwise_apply=False)
        for container in (patches, K.ImageSequential(K.RandomGamma())):
            with (
                pytest.raises(ValueError, match=r"no augmentation in \w+ reads a depth map"),
                bound_depth(container, scene(2)[1]),
            ):
                pass

    def test_exception_another_size(self):
        optics, (image, depth) = augmentation(), scene(2)
        with bound_depth(optics, depth[..., :-1]), pytest.raises(ValueError, match="to fit the image"):
            optics(image)


class _Corners:
    """What ``crops`` reads: the draws of the crop as those of the second child."""

    def __init__(self, sequence: K.AugmentationSequential) -> None:
        self._params = [sequence._params[0], sequence._params[-1]]


def camera_of(optics: RandomTiDyOptics) -> nn.Module:
    return optics.optics
