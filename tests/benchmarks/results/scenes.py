"""Scenes of the benchmark: an image and its normalised inverse depth, for cameras of any depth range."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from kornia_tidy import ThinLensCamera
from kornia_tidy.data import DeadLeaves, central_crop
from kornia_tidy.reconstruction.tasks import metres, normalised_inverse_depth, stretched
from tests.benchmarks.system_scores import LARGEST, LEAVES, LEAVES_SEED, LEAVES_SIZE
from tests.scenes import ENTRIES, halves, load_scene

REFERENCE = ThinLensCamera()


class BenchScene(NamedTuple):
    """A scene that is photographed; maps are (1, C, H, W)."""

    name: str
    image: Tensor
    """sRGB in [0, 1]."""
    inverse_depth: Tensor
    """Normalised: 0 at the far end of the camera's range, 1 at the near end."""
    known: Tensor
    """bool, True where the depth is known."""

    def depth(self, camera: ThinLensCamera) -> Tensor:
        """Return the depth in metres, stretched in dioptres over a camera's range."""
        return metres(camera, self.inverse_depth)


class SceneSet(NamedTuple):
    """Scenes by name, in two halves."""

    name: str
    half_a: list[str]
    half_b: list[str]
    load: Callable[[str], BenchScene]

    @property
    def names(self) -> list[str]:
        """All scenes, of half A first."""
        return [*self.half_a, *self.half_b]


def real_scenes() -> SceneSet:
    """Return the 35 real scenes, on which nothing is trained; an empty set where their files are missing."""
    return SceneSet("real", *halves(ENTRIES), lru_cache(maxsize=None)(_real))


def dead_leaves(count: int = LEAVES, size: int = LEAVES_SIZE) -> SceneSet:
    """Return dead leaves of a seed that no training uses."""
    painted = DeadLeaves(count, size, size, depth_range=REFERENCE.depth_range, seed=LEAVES_SEED)
    numbers = {f"leaves {index:02d}": index for index in range(count)}

    def load(name: str) -> BenchScene:
        image, depth, known = painted.read(numbers[name])
        return _scene(name, image, depth, known)

    return SceneSet("leaves", *halves(numbers), lru_cache(maxsize=None)(load))


def _real(name: str) -> BenchScene:
    image, depth, known = load_scene(name)
    sample = {"image": image.expand(3, -1, -1), "depth": stretched(depth, known, REFERENCE), "mask": known}
    cropped = central_crop(sample, (min(LARGEST, image.shape[-2]), min(LARGEST, image.shape[-1])))
    return _scene(name, cropped["image"], cropped["depth"], cropped["mask"])


def _scene(name: str, image: Tensor, depth: Tensor, known: Tensor) -> BenchScene:
    inverse_depth = normalised_inverse_depth(REFERENCE, depth)
    return BenchScene(name, image[None].float(), inverse_depth[None], known[None].to(torch.bool))
