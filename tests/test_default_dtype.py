"""Draws of a seed under another default data type of torch: those of float32, rounded once."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import kornia.augmentation as K
import pytest
import torch
from torch import Tensor

from kornia_tidy import Fidelity, PixelwiseMask, SensorNoise, TiDyOptics
from kornia_tidy import augmentation as ours
from kornia_tidy.choices import STARTS
from kornia_tidy.data import DeadLeaves, dead_leaves, photographic_leaves, random_crop
from kornia_tidy.design import DesignTask
from kornia_tidy.design.candidates import initial_phase
from kornia_tidy.masks import initial_heights
from kornia_tidy.optics import SYSTEMS, ThinLensCamera
from kornia_tidy.seeds import item_generator
from kornia_tidy.training.noisy_crops import random_error, random_gain, random_sensor
from kornia_tidy.training.scenes import augmented
from kornia_tidy.training.settings import LightSettings
from tests.base import BaseTester
from tests.masks.registry import ONE_MASK, TWO_MASKS

HALVES = [pytest.param(kind, marks=pytest.mark.takes_seconds) for kind in (torch.float16, torch.bfloat16)]
SINGLE = torch.float32
LENS: dict[str, Any] = {"focal_length": 10e-3, "pixel_pitch": 4e-6}


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(1)


def image() -> Tensor:
    return torch.rand(1, 3, 12, 16, generator=generator(), dtype=SINGLE)


def depth() -> Tensor:
    return 0.4 + torch.rand(1, 1, 12, 16, generator=generator(), dtype=SINGLE)


def camera() -> TiDyOptics:
    return TiDyOptics(PixelwiseMask(2, generator=generator()), sensor=SensorNoise(0.01), fidelity=Fidelity(window=9))


def by_global_generator(draw: Callable[[], Any]) -> Any:
    with torch.random.fork_rng():
        torch.manual_seed(1)
        return draw()


def of_augmentation(make: Callable[[], K.IntensityAugmentationBase2D]) -> dict[str, Tensor]:
    return by_global_generator(lambda: make().forward_parameters(image().shape))


NOISE = SensorNoise(0.01, full_well=1000.0)
DRAWS: dict[str, Callable[[], Any]] = {
    **{f"mask {name}": lambda make=make: make(generator()).phase for name, make in ONE_MASK.items()},
    **{f"masks {name}": lambda make=make: by_global_generator(make).phase for name, make in TWO_MASKS.items()},
    **{f"heights {start}": partial(lambda start: initial_heights(start, generator()), start) for start in STARTS},
    **{
        f"preset {name}": partial(lambda name: TiDyOptics.from_preset(name, generator=generator()).masks.phase, name)
        for name in SYSTEMS
    },
    **{
        f"design {start}": partial(lambda start: initial_phase(DesignTask(), start, 8.0, 0.5, 3), start)
        for start in ("focal sweep", "Fisher", "random")
    },
    "noise": lambda: NOISE.draw((1, 3, 70, 5), generator=generator()),
    "noisy image": lambda: NOISE(image(), generator=generator()),
    "dead leaves": lambda: dead_leaves(24, 32, num_leaves=20, seed=1),
    "photographic leaves": lambda: photographic_leaves(24, 32, seed=1),
    "items": lambda: {key: x for key, x in DeadLeaves(1, 24, 32, num_leaves=20)[0].items() if isinstance(x, Tensor)},
    "crop": lambda: random_crop({"image": image()[0]}, (5, 7), item_generator(0, 1)),
    "training scene": lambda: by_global_generator(lambda: augmented(image()[0], depth()[0], depth()[0] > 1)),
    "training gain": lambda: by_global_generator(lambda: random_gain(torch.tensor([1.0, 0.8, 0.5], dtype=SINGLE))),
    "training error": lambda: by_global_generator(lambda: torch.tensor(random_error(), dtype=SINGLE)),
    "training sensor": lambda: by_global_generator(
        lambda: torch.tensor(random_sensor(LightSettings(), ThinLensCamera()).sigma, dtype=SINGLE)
    ),
    "RandomDepthBlur": lambda: of_augmentation(lambda: ours.RandomDepthBlur(p=1.0, **LENS)),
    "RandomSensorNoise": lambda: of_augmentation(lambda: ours.RandomSensorNoise(p=1.0)),
    "RandomTiDyOptics": lambda: of_augmentation(lambda: ours.RandomTiDyOptics(camera(), exposure=(0.5, 1.0), p=1.0)),
}


def tensors(found: Any) -> list[Tensor]:
    if isinstance(found, Tensor):
        return [found.detach()]
    values = found.values() if isinstance(found, dict) else found
    return [x.detach() for x in values if isinstance(x, Tensor)]


def under(kind: torch.dtype, draw: Callable[[], Any]) -> list[Tensor]:
    torch.set_default_dtype(kind)
    try:
        return tensors(draw())
    finally:
        torch.set_default_dtype(SINGLE)


class TestDefaultDtype(BaseTester):
    @pytest.mark.parametrize("kind", [torch.float64, *HALVES], ids=lambda kind: str(kind).removeprefix("torch."))
    @pytest.mark.parametrize("name", DRAWS)
    def test_feature_a_seed_draws_the_same(self, name, kind):
        expected, found = tensors(DRAWS[name]()), under(kind, DRAWS[name])
        assert len(found) == len(expected) > 0
        for one, other in zip(found, expected, strict=True):
            if not other.is_floating_point():
                assert torch.equal(one, other)
                continue
            unit = max(torch.finfo(one.dtype).eps, torch.finfo(SINGLE).eps)
            self.assert_close(one.double(), other.double(), rtol=4 * unit, atol=4 * unit * float(other.abs().max()))
