from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import Any

import kornia.augmentation as K
import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from kornia_tidy.augmentation import OpticsPipeline, RandomDepthBlur, RandomTiDyOptics, depth_blur
from tests.base import BaseTester
from tests.camera.pipeline_samples import Scenes, camera, scene

LOADERS = [(0, None), (2, "fork"), pytest.param(2, "spawn", marks=pytest.mark.slow)]  # it imports all again

# Python 3.12 and later: every process that uses torch has threads, and fork says so.
pytestmark = pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")


def pipeline() -> OpticsPipeline:
    torch.manual_seed(11)
    optics = RandomTiDyOptics(camera(), exposure=(0.5, 1.0), focus_distance=(0.5, 0.8), noise_level=(0.01, 0.1), p=0.7)
    return OpticsPipeline(K.RandomCrop((40, 48)), optics, K.ColorJiggle(0.2, 0.2, p=0.5))


@lru_cache
def load(workers: int, context: str | None) -> list[dict[str, Any]]:
    chain = pipeline()
    torch.manual_seed(5)
    loader = DataLoader(
        Scenes({"seeded": chain.as_transform(seed=3), "unseeded": chain.as_transform()}),
        batch_size=2,
        num_workers=workers,
        multiprocessing_context=context,
        timeout=120 * bool(workers),
    )
    return list(loader)


def entries(batches: list[dict[str, Any]], transform: str, name: str) -> torch.Tensor:
    return torch.cat([batch[transform][name] for batch in batches])


class TestPipelineTransform(BaseTester):
    @pytest.mark.parametrize(("workers", "context"), LOADERS)
    def test_feature_an_item_is_the_same_whoever_loads_it(self, workers, context):
        """Against a plain loop in this process, in reverse order."""
        data = Scenes({"seeded": pipeline().as_transform(seed=3)})
        items = [data[index]["seeded"] for index in (3, 2, 1, 0)]
        for name in ("image", "depth", "all_in_focus"):
            expected = torch.stack([item[name] for item in items]).flip(0)
            assert torch.equal(entries(load(workers, context), "seeded", name), expected)

    @pytest.mark.parametrize(("workers", "context"), LOADERS)
    def test_feature_nothing_carries_gradients(self, workers, context):
        assert not entries(load(workers, context), "unseeded", "image").requires_grad

    def test_feature_the_global_generator_is_left_alone(self):
        data = Scenes({"seeded": pipeline().as_transform(seed=3)})
        before = torch.get_rng_state()
        data[0]
        assert not torch.equal(data[0]["seeded"]["image"], data[1]["seeded"]["image"])
        assert torch.equal(torch.get_rng_state(), before)

    @pytest.mark.parametrize("seed", [None, 3])
    def test_cardinality(self, seed):
        """Single samples, also such as have a batch axis of one, keep their rank and get the size of the crop."""
        transform, (image, depth) = pipeline().as_transform(seed=seed), scene(1, height=64, width=64)
        for lead, sample in (((), (image[0], depth[0])), ((1,), (image, depth))):
            out = transform({"image": sample[0], "depth": sample[1], "index": 2})
            assert out["image"].shape == out["all_in_focus"].shape == (*lead, 3, 40, 48)
            assert out["depth"].shape == (*lead, 1, 40, 48)

    def test_exception_a_seed_without_the_key(self):
        with pytest.raises(KeyError, match=r"tells items apart by sample\['index'\]"):
            pipeline().as_transform(seed=3)({"image": torch.rand(3, 64, 64), "depth": torch.ones(1, 64, 64)})


@pytest.fixture(autouse=True, scope="module")
def _forget_batches() -> Iterator[None]:
    yield
    load.cache_clear()


LENS = {"focus_distance": (0.6, 0.6), "f_number": (4.0, 4.0), "p": 1.0}


class TestAugmentationTransform(BaseTester):
    def sample(self):
        generator = torch.Generator().manual_seed(3)
        image = torch.randint(0, 256, (3, 40, 48), dtype=torch.uint8, generator=generator)
        millimetres = torch.randint(500, 3000, (40, 48), generator=generator)
        return image, millimetres

    @pytest.mark.parametrize("kind", ["tensors", "arrays of 8 bits", "arrays of 16 bits", "tuple", "floats"])
    def test_feature_is_the_function_for_samples_of_any_kind(self, kind):
        image, millimetres = self.sample()
        metres = millimetres[None] * 0.001
        transform = RandomDepthBlur(**LENS).as_transform(depth_scale=0.001)
        expected = depth_blur(image[None] / 255, metres[None], 0.6, 4.0)[0]
        batch = transform({"image": image[None] / 255, "depth": millimetres[None, None].to(torch.int32)})["image"]
        self.assert_close(batch, expected[None], atol=1e-6)
        if kind == "tensors":
            out = transform({"image": image, "depth": millimetres[None].to(torch.int32)})["image"] / 255
        elif kind == "tuple":
            out = transform((image, millimetres[None].to(torch.int32), "name"))[0] / 255
        elif kind == "floats":
            out = RandomDepthBlur(**LENS).as_transform()({"image": image / 255, "depth": metres})["image"]
        else:
            array = image.permute(1, 2, 0).numpy()
            array = array if "8" in kind else array.astype(np.uint16) * 257
            coded = transform({"image": array, "depth": millimetres.numpy().astype(np.uint16)})["image"]
            assert (coded.dtype, coded.shape) == (array.dtype, array.shape)
            out = torch.from_numpy(coded / np.iinfo(array.dtype).max).permute(2, 0, 1).float()
        assert out.shape == expected.shape
        self.assert_close(
            out, expected, rtol=0, atol=0.51 / 255 if kind in ("tensors", "tuple") or "8" in kind else 1e-5
        )

    def test_feature_an_item_has_its_draws_and_the_generator_of_torch_stays(self):
        image, millimetres = self.sample()
        transform = RandomDepthBlur(p=1.0).as_transform(seed=1, depth_scale=0.001)
        items = [{"image": image, "depth": millimetres[None].to(torch.int32), "index": n} for n in (0, 1, 0)]
        torch.manual_seed(5)
        before = torch.get_rng_state()
        first, other, again = (transform(item)["image"] for item in items)
        assert torch.equal(torch.get_rng_state(), before)
        assert torch.equal(first, again)
        assert not torch.equal(first, other)

    def test_exception_whole_numbers(self):
        image, millimetres = self.sample()
        blur = RandomDepthBlur(**LENS)
        with pytest.raises(ValueError, match="depth_scale"):
            blur.as_transform()({"image": image, "depth": millimetres.numpy().astype(np.uint16)})
        with pytest.raises(TypeError, match=r"image must be floating point in \[0, 1\], got torch.uint8: divide it by"):
            blur(image, millimetres[None] * 0.001)
