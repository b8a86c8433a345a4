"""One seed, one result: the augmentations alone, in kornia's containers and in the workers of a data loader.

The checks are those of kornia's own augmentations: the seed, the draw handed back as ``params``, ``same_on_batch``.
"""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from typing import Any

import kornia.augmentation as K
import pytest
import torch
from torch import Tensor, nn

from kornia_tidy.augmentation import RandomDepthBlur, RandomSensorNoise, RandomTiDyOptics, bound_depth
from tests.base import BaseTester
from tests.camera.pipeline_samples import camera, scene

LENS: dict[str, Any] = {"focal_length": 10e-3, "pixel_pitch": 4e-6}
RANGES: dict[str, Any] = {
    "exposure": (0.5, 1.0),
    "focus_distance": (0.5, 0.8),
    "mask_jitter": (0.1, 0.3),
    "noise_level": (0.01, 0.1),
}
AUGMENTATIONS: dict[str, Callable[..., Any]] = {
    "RandomTiDyOptics": lambda **options: RandomTiDyOptics(camera(), **RANGES, **options),
    "RandomDepthBlur": lambda **options: RandomDepthBlur(f_number=(1.0, 4.0), **LENS, **options),
    "RandomSensorNoise": lambda **options: RandomSensorNoise((1e2, 1e3), dark=(1.0, 5.0), **options),
}
BATCH = 4
# Python 3.12 and later: every process that uses torch has threads, and fork says so.
pytestmark = pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")


def needs_depth(augmentation: nn.Module) -> bool:
    return hasattr(augmentation, "depth_tap")


class Alone:
    """The augmentation itself."""

    def __init__(self, augmentation: Any) -> None:
        self.module, self.depth = augmentation, needs_depth(augmentation)

    def __call__(self, image: Tensor, depth: Tensor, params: Any = None) -> Tensor:
        return self.module(image, *([depth] if self.depth else []), params=params)


class InAugmentationSequential(Alone):
    """Between a flip and a crop, behind its tap."""

    def __init__(self, augmentation: Any) -> None:
        super().__init__(augmentation)
        parts = [augmentation.depth_tap] if self.depth else []
        self.module = K.AugmentationSequential(
            K.RandomHorizontalFlip(),
            *parts,
            augmentation,
            K.RandomCrop((32, 36)),
            data_keys=["input", "mask"],
            same_on_batch=augmentation.same_on_batch,
        )

    def __call__(self, image: Tensor, depth: Tensor, params: Any = None) -> Tensor:
        return torch.cat(self.module(image, depth, params=params), 1)


class InImageSequential(Alone):
    """Before a change of colours, with the depth bound."""

    def __init__(self, augmentation: Any) -> None:
        super().__init__(augmentation)
        self.module = K.ImageSequential(augmentation, K.ColorJiggle(0.2, 0.2), same_on_batch=augmentation.same_on_batch)

    def __call__(self, image: Tensor, depth: Tensor, params: Any = None) -> Tensor:
        if not self.depth:
            return self.module(image, params=params)
        with bound_depth(self.module, depth):
            return self.module(image, params=params)


class InVideoSequential(InImageSequential):
    """Frames of a video, each with a draw of its own."""

    same_on_frame = False

    def __init__(self, augmentation: Any) -> None:
        super().__init__(augmentation)
        self.module = K.VideoSequential(augmentation, data_format="BTCHW", same_on_frame=self.same_on_frame)

    def __call__(self, image: Tensor, depth: Tensor, params: Any = None) -> Tensor:
        return super().__call__(image.unflatten(0, (-1, 2)), depth.unflatten(0, (-1, 2)), params).flatten(0, 1)


class InVideoSequentialSame(InVideoSequential):
    """Frames of a video, all of one draw."""

    same_on_frame = True


WAYS = [Alone, InAugmentationSequential, InImageSequential, InVideoSequential, InVideoSequentialSame]


def seeded(way: Alone, seed: int, *given: Any) -> Tensor:
    torch.manual_seed(seed)
    return way(*given).detach()


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", AUGMENTATIONS)
class TestReproducibility(BaseTester):
    @pytest.mark.parametrize("p", [0.5, 1.0])
    def test_feature_one_seed_or_draw_one_result_and_another_seed_another(self, name, way, p):
        """The draw is handed back, and copies and pickles draw the same."""
        made, given = way(AUGMENTATIONS[name](p=p)), scene(BATCH)
        first, params = seeded(made, 3, *given), copy.deepcopy(made.module._params)
        assert not torch.equal(seeded(made, 4, *given), first)
        assert torch.equal(made(*given, params), first)
        other = copy.deepcopy(made) if p == 1 else pickle.loads(pickle.dumps(made))
        assert torch.equal(seeded(other, 3, *given), first)

    def test_feature_same_on_batch(self, name, way):
        """Four equal images: one draw makes them equal again, draws of their own do not."""
        image, depth = (x.expand(BATCH, -1, -1, -1) for x in scene(1))
        same, own = (
            seeded(way(AUGMENTATIONS[name](p=1.0, same_on_batch=same)), 3, image, depth) for same in (True, False)
        )
        assert torch.equal(same, same[:1].expand_as(same))
        assert not torch.equal(own[:1].expand_as(own), own)


@pytest.mark.parametrize("name", AUGMENTATIONS)
class TestProbability(BaseTester):
    def test_feature_images_that_are_left_out_keep_their_bits(self, name):
        made, (image, depth) = Alone(AUGMENTATIONS[name](p=0.5)), scene(6)
        changed, left = seeded(made, 1, image, depth), made.module._params["batch_prob"] < 0.5
        assert 0 < left.sum() < 6
        assert torch.equal(changed[left], image[left])
        assert not (changed[~left] == image[~left]).flatten(1).all(1).any()

    @pytest.mark.parametrize("p", [2.0, -0.1, float("nan")])
    def test_exception(self, name, p):
        with pytest.raises(ValueError, match=rf"p must be a probability from 0 to 1, got {p}$"):
            AUGMENTATIONS[name](p=p)
        with pytest.raises(TypeError, match="p must be a number"):
            AUGMENTATIONS[name](p="often")
