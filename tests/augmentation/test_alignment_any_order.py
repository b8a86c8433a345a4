"""All orders of geometry, optics and photometry in three libraries: aligned image and depth, or an error.

Random chains of up to three warps, interpolating ones (affine, rotation, resize) too.
"""

from __future__ import annotations

from collections.abc import Sequence

import kornia.augmentation as K
import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor

from kornia_tidy.augmentation import OpticsPipeline
from tests.augmentation.optional import need, need_torchvision
from tests.augmentation.ratio_scene import RatioMark, assert_ratios, ratio_scene
from tests.base import BaseTester

EXAMPLES = settings(max_examples=40, suppress_health_check=[HealthCheck.too_slow])
WARPS = ("flip", "flop", "crop", "turn", "affine", "resize")


class Dimmed(K.IntensityAugmentationBase2D):
    """A factor of brightness, which leaves the ratios alone."""

    def __init__(self) -> None:
        super().__init__(p=1.0)

    def apply_transform(self, image: Tensor, params: object, flags: object, transform: object = None) -> Tensor:
        return 0.8 * image


KORNIA = {
    "flip": lambda: K.RandomHorizontalFlip(p=0.7),
    "flop": lambda: K.RandomVerticalFlip(p=0.7),
    "crop": lambda: K.RandomResizedCrop((20, 28), scale=(0.6, 1.0), p=1.0),
    "turn": lambda: K.RandomRotation((-40.0, 40.0), p=0.8),
    "affine": lambda: K.RandomAffine(20.0, translate=(0.1, 0.1), scale=(0.8, 1.2), p=0.8),
    "resize": lambda: K.Resize((20, 36)),
    "dim": Dimmed,
}


def orders() -> st.SearchStrategy[list[str]]:
    """Up to three warps, one dimming and the optics, in any order."""
    parts = st.lists(st.sampled_from(WARPS), max_size=3)
    return parts.flatmap(lambda warps: st.permutations([*warps, "dim", "optics"]))


def check_kornia(names: Sequence[str], seed: int, keys: list[str] | None) -> None:
    """Run a chain of kornia on a scene and assert that image and depth are aligned."""
    torch.manual_seed(seed)
    optics, parts = RatioMark(p=1.0), []
    optics.depth_tap.mask = 0
    for name in names:
        parts += [optics.depth_tap, optics] if name == "optics" else [KORNIA[name]()]
    chain = K.AugmentationSequential(*parts, data_keys=keys)
    image, depth = ratio_scene()
    if keys is None:
        out = chain({"image": image, "mask_depth": depth})
        coded, warped = out["image"], out["mask_depth"]
    else:
        coded, warped = chain(image, depth, *[torch.zeros_like(depth)] * (len(keys) - 2))[:2]
    assert_ratios(coded, warped, True, len(names) - 2)


def check_torchvision(names: Sequence[str], seed: int, kind: str) -> None:
    """Run a chain of torchvision v2 on a scene and assert that image and depth are aligned."""
    from torchvision import tv_tensors
    from torchvision.transforms import v2

    from kornia_tidy.augmentation.torchvision_v2 import Depth, OpticsTransform

    torch.manual_seed(seed)
    make = {
        "flip": lambda: v2.RandomHorizontalFlip(0.7),
        "flop": lambda: v2.RandomVerticalFlip(0.7),
        "crop": lambda: v2.RandomResizedCrop((20, 28), scale=(0.6, 1.0)),
        "turn": lambda: v2.RandomRotation(40, interpolation=v2.InterpolationMode.BILINEAR),
        "affine": lambda: v2.RandomAffine(20, (0.1, 0.1), (0.8, 1.2)),
        "resize": lambda: v2.Resize((20, 36)),
        "dim": lambda: v2.ColorJitter(brightness=(0.8, 0.8)),
        "optics": lambda: OpticsTransform(RatioMark(p=1.0)),
    }
    image, depth = (x[:1] for x in ratio_scene())
    given_image = {
        "image": lambda: tv_tensors.Image(image),
        "plain": lambda: image,
        "pil": lambda: v2.functional.to_pil_image(image[0]),
    }[kind]()
    chain = v2.Compose([make[name]() for name in names])
    out = chain({"image": given_image, "depth": Depth(depth if kind != "pil" else depth[0])})
    coded = out["image"] if kind != "pil" else v2.functional.to_dtype(v2.functional.to_image(out["image"]), scale=True)
    coded, warped = (x.as_subclass(Tensor).reshape(1, -1, *x.shape[-2:]).float() for x in (coded, out["depth"]))
    assert_ratios(coded, warped, True, len(names) - 2 + (kind == "pil"))


def check_albumentations(names: Sequence[str], seed: int, nested: bool) -> None:
    """Run a chain of albumentations on a scene and assert that image and depth are aligned."""
    import albumentations as A

    from kornia_tidy.augmentation.albumentations_v2 import OpticsTransform

    make = {
        "flip": lambda: A.HorizontalFlip(p=0.7),
        "flop": lambda: A.VerticalFlip(p=0.7),
        "crop": lambda: A.RandomResizedCrop((20, 28), scale=(0.6, 1.0)),
        "turn": lambda: A.Rotate((-40, 40), p=0.8),
        "affine": lambda: A.Affine(scale=(0.8, 1.2), translate_percent=(-0.1, 0.1), rotate=(-20, 20), p=0.8),
        "resize": lambda: A.Resize(20, 36),
        "dim": lambda: A.MultiplicativeNoise((0.8, 0.8), p=1.0),
        "optics": lambda: OpticsTransform(RatioMark(p=1.0)),
    }
    parts = [make[name]() for name in names]
    if nested:
        parts = [A.Sequential(parts[:2], p=1.0), *parts[2:]]
    chain = A.Compose(parts, additional_targets={"depth": "mask"}, seed=seed)
    image, depth = (np.ascontiguousarray(x[0].permute(1, 2, 0).numpy()) for x in ratio_scene())
    out = chain(image=image, depth=depth)
    coded, warped = (torch.from_numpy(out[name]).permute(2, 0, 1)[None] for name in ("image", "depth"))
    assert_ratios(coded, warped, True, len(names) - 2)


class TestAlignmentInAnyOrder(BaseTester):
    @pytest.mark.parametrize("warp", ["flip", "flop", "turn", "affine"])
    def test_exception_the_check_sees_an_image_that_moved_alone(self, warp):
        """Otherwise the properties below would say nothing."""
        torch.manual_seed(2)
        image, depth = ratio_scene()
        with pytest.raises(AssertionError):
            assert_ratios(KORNIA[warp]()(image), depth, False, 1)

    @EXAMPLES
    @given(orders(), st.integers(0, 2**31), st.sampled_from([["input", "mask"], ["input", "mask", "mask"], None]))
    def test_property_kornia(self, names, seed, keys):
        check_kornia(names, seed, keys)

    @EXAMPLES
    @given(st.lists(st.sampled_from([*WARPS, "dim"]), max_size=4), st.integers(0, 2**31), st.booleans())
    def test_property_kornia_in_a_pipeline(self, names, seed, nested):
        torch.manual_seed(seed)
        made = [KORNIA[name]() for name in names] or [Dimmed()]
        geometry = K.AugmentationSequential(*made, data_keys=None)
        geometry = K.AugmentationSequential(geometry, data_keys=None) if nested else geometry
        image, depth = ratio_scene()
        try:
            out = OpticsPipeline(geometry, RatioMark(p=1.0), Dimmed())({"image": image, "depth": depth})
        except ValueError as error:
            if "depth" not in str(error):
                raise
            return
        assert_ratios(out["image"], out["depth"], True, len(names))

    @EXAMPLES
    @given(orders(), st.integers(0, 2**31), st.sampled_from(["image", "pil", "plain"]))
    def test_property_torchvision(self, names, seed, kind):
        need_torchvision(module=False)
        check_torchvision(names, seed, kind)

    @EXAMPLES
    @given(orders(), st.integers(0, 2**31), st.booleans())
    def test_property_albumentations(self, names, seed, nested):
        need("albumentations", module=False)
        check_albumentations(names, seed, nested)
