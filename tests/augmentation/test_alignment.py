"""Image and depth stay aligned over all orders of geometry, optics and photometry, or the call ends in an error.

The same is tested for torchvision and albumentations in their own files.
"""

from __future__ import annotations

from itertools import permutations

import kornia.augmentation as K
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import nn

from kornia_tidy.augmentation import OpticsPipeline, bound_depth
from tests.augmentation.coded_scene import MOVED, MarkDepth, ThirdChannel, assert_aligned, coded_scene
from tests.base import BaseTester

GEOMETRY = {
    "flip": lambda: K.RandomHorizontalFlip(p=1.0),
    "maybe flip": lambda: K.RandomVerticalFlip(p=0.5),
    "crop": lambda: K.RandomCrop((20, 24), p=1.0),
    "turn": lambda: K.RandomRotation((90.0, 90.0), p=1.0),
}
PHOTOMETRY = {
    "gamma": ThirdChannel,
    "erase": lambda: K.RandomErasing(scale=(0.02, 0.05), p=1.0),
}


def assert_told(error: ValueError) -> None:
    """The error is ours, and tells of the depth; kornia refuses crops of a size that is not there."""
    assert "depth" in str(error) or "crop" in str(error).lower()


class TestAlignment(BaseTester):
    @settings(max_examples=25)
    @given(st.lists(st.sampled_from([*GEOMETRY, *PHOTOMETRY, "tap", "optics"]), min_size=2, max_size=6), st.booleans())
    def test_property_any_list_of_augmentations(self, names, shuffled):
        names = [name for n, name in enumerate(names) if name not in ("tap", "optics") or name not in names[:n]]
        optics = MarkDepth(p=1.0)  # a container holds a module once
        made = {**GEOMETRY, **PHOTOMETRY, "tap": lambda: optics.depth_tap, "optics": lambda: optics}
        chain = K.AugmentationSequential(
            *(made[name]() for name in names),
            data_keys=["input", "mask"],
            random_apply=len(names) if shuffled else False,
        )
        image, depth = coded_scene()
        try:
            image, depth = chain(image, depth)
        except ValueError as error:
            assert_told(error)
            return
        if "optics" in names and image[:, 0].abs().sum():  # a random order may leave the optics out
            known = (depth > 0)[:, 0] & (image[:, 1] > 0)
            assert (image[:, 1] - image[:, 0])[known].abs().max() < MOVED
            assert (image[:, 1] - depth[:, 0])[known].abs().max() < MOVED

    @pytest.mark.parametrize("geometry", list(GEOMETRY))
    def test_property_the_pipeline_and_its_refusals(self, geometry):
        image, depth = coded_scene()
        pipeline = OpticsPipeline(GEOMETRY[geometry](), MarkDepth(p=1.0), ThirdChannel())
        assert_aligned(*pipeline(image, depth))
        out = pipeline({"image": image, "depth": depth})
        assert_aligned(out["image"], out["depth"])
        with pytest.raises(ValueError, match="photometry may not move pixels"):
            OpticsPipeline(None, MarkDepth(p=1.0), GEOMETRY[geometry]())

    @pytest.mark.parametrize("geometry", list(GEOMETRY))
    @pytest.mark.parametrize("container", [K.ImageSequential, K.AugmentationSequential, nn.Sequential])
    def test_property_a_bound_depth_goes_with_no_geometry(self, geometry, container):
        for order in permutations([GEOMETRY[geometry](), MarkDepth(p=1.0), ThirdChannel()]):
            with (
                pytest.raises(ValueError, match="may move pixels, and a bound depth does not"),
                bound_depth(container(*order), coded_scene()[1]),
            ):
                pass
        chain = container(ThirdChannel(), MarkDepth(p=1.0))
        image, depth = coded_scene()
        with bound_depth(chain, depth):
            assert_aligned(chain(image), depth)
