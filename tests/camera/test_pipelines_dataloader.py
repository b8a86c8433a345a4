from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import Any

import pytest
import torch
from torch.utils.data import DataLoader

from kornia_tidy import TiDyOptics
from tests.base import BaseTester
from tests.camera.pipeline_samples import Scenes, camera, scene

LOADERS = [(0, None), (2, "fork"), pytest.param(2, "spawn", marks=pytest.mark.takes_seconds)]

# Python 3.12 and later: every process that uses torch has threads, and fork says so.
pytestmark = pytest.mark.filterwarnings("ignore:.*multi-threaded, use of fork:DeprecationWarning")


@lru_cache
def load(workers: int, context: str | None) -> list[dict[str, Any]]:
    """All batches of the scenes, through a learnable camera itself and through its transforms."""
    torch.manual_seed(11)
    optics = camera()
    transforms = {"learnable": optics, "unseeded": optics.as_transform(), "seeded": optics.as_transform(seed=3)}
    loader = DataLoader(
        Scenes(transforms),
        batch_size=2,
        num_workers=workers,
        multiprocessing_context=context,
        timeout=120 * bool(workers),
    )
    return list(loader)


def images(batches: list[dict[str, Any]], transform: str) -> torch.Tensor:
    return torch.cat([batch[transform]["image"] for batch in batches])


@pytest.mark.parametrize(("workers", "context"), LOADERS)
class TestDataLoader(BaseTester):
    def test_feature_scenes_are_coded_in_order_and_the_clean_image_stays(self, workers, context):
        batches = load(workers, context)
        clean = torch.cat([scene(1, height=64, width=64, seed=index)[0] for index in range(4)])
        assert torch.equal(torch.cat([batch["learnable"]["all_in_focus"] for batch in batches]), clean)
        blur = (images(batches, "learnable") - clean).abs().mean((1, 2, 3))
        assert ((blur > 0.05) & (blur < 0.5)).all()

    def test_feature_learnable_output_is_detached_in_workers_only(self, workers, context):
        assert images(load(workers, context), "learnable").requires_grad == (workers == 0)

    def test_feature_a_transform_never_carries_gradients(self, workers, context):
        batches = load(workers, context)
        assert not images(batches, "seeded").requires_grad
        assert not images(batches, "unseeded").requires_grad

    def test_feature_item_seeds_draw_the_same_bits_as_a_plain_call_with_the_items_generator(self, workers, context):
        # The reference loads nothing: it draws in this process, item by item, in reverse order.
        torch.manual_seed(11)
        transform = camera().as_transform(seed=3)
        data = Scenes({"seeded": transform})
        expected = torch.stack([data[index]["seeded"]["image"] for index in (3, 2, 1, 0)]).flip(0)
        assert torch.equal(images(load(workers, context), "seeded"), expected)


class Identical(Scenes):
    """The same scene four times, so that only the noise differs."""

    def __getitem__(self, index: int) -> dict[str, Any]:
        sample = {"image": torch.full((3, 24, 24), 0.5), "depth": torch.full((1, 24, 24), 0.6), "index": index}
        return {name: transform(sample) for name, transform in self.transforms.items()}


class TestDatasetTransform(BaseTester):
    def test_feature_items_have_unrelated_noise_and_epochs_have_the_same(self):
        data = Identical({"a": camera(color_space="linear").as_transform(seed=0)})
        noise = torch.stack([data[index]["a"]["image"].flatten() for index in range(4)])
        correlation = torch.corrcoef(noise) - torch.eye(4)
        assert correlation.abs().max() < 4 / noise.shape[1] ** 0.5  # four standard errors of independent noise
        assert torch.equal(noise[2], data[2]["a"]["image"].flatten())

    def test_feature_seeds_and_only_seeds_change_the_noise(self):
        optics = camera()
        one, same, other = (Identical({"a": optics.as_transform(seed=s)})[1]["a"]["image"] for s in (1, 1, 2))
        assert torch.equal(one, same)
        assert not torch.equal(one, other)

    def test_feature_a_seeded_transform_leaves_the_global_generator_alone(self):
        data, before = Identical({"a": camera().as_transform(seed=1)}), torch.get_rng_state()
        data[0]
        assert torch.equal(torch.get_rng_state(), before)

    def test_feature_key_may_be_a_function_of_a_tuple_sample(self):
        transform = camera().as_transform(seed=1, key=lambda sample: sample[2])
        image, depth = (x[0] for x in scene(1))
        coded, same_depth, index = transform((image, depth, 7))
        assert coded.shape == image.shape
        assert same_depth is not None
        assert index == 7
        assert torch.equal(coded, transform((image, depth, 7))[0])
        assert not torch.equal(coded, transform((image, depth, 8))[0])

    @pytest.mark.parametrize("form", ["mapping", "tuple"])
    def test_exception_a_seed_without_the_items_key_is_refused_before_any_draw(self, form):
        image, depth = (x[0] for x in scene(1))
        sample = {"image": image, "depth": depth} if form == "mapping" else (image, depth)
        transform, before = camera().as_transform(seed=0), torch.get_rng_state()
        with pytest.raises(KeyError, match=r"tells items apart by sample\['index'\]"):
            transform(sample)
        assert torch.equal(torch.get_rng_state(), before)

    @pytest.mark.parametrize("compositing", ["gather", "scatter"])
    def test_feature_threads_of_the_loading_process_change_no_bit(self, compositing):
        """Nor what it rendered before, with all of them: PSFs that it remembers are of sums in another order."""
        optics = TiDyOptics(compositing=compositing, check_inputs=False)
        transform, before = optics.as_transform(seed=1), torch.get_num_threads()
        samples = [
            {"image": torch.rand(3, n, n), "depth": 0.4 + torch.rand(1, n, n), "index": n} for n in (48, 96, 200)
        ]
        taken = []
        try:
            for threads in (1, 2, 3, 4):
                torch.set_num_threads(threads)
                optics({**samples[0]})
                taken.append([transform(sample)["image"] for sample in samples])
                assert torch.get_num_threads() == threads
        finally:
            torch.set_num_threads(before)
        for other in taken[1:]:
            assert all(map(torch.equal, taken[0], other))


@pytest.fixture(autouse=True, scope="module")
def _forget_batches() -> Iterator[None]:
    yield
    load.cache_clear()
