"""An augmentation pipeline as the transform of a data set: the same draws for an item, whoever loads it."""

from __future__ import annotations

from typing import Any

import torch

from kornia_tidy.camera.dataset_transform import DatasetTransform


class PipelineTransform(DatasetTransform):
    """Call a pipeline on single samples inside a data set. Made by ``pipeline.as_transform()``.

    Args:
        optics: the pipeline.
        seed: None draws from the global generator of torch, which differs from worker to worker. A number gives each
            item its own draws, the same for any number of workers, for fork and spawn, and in every epoch.
        key: with a seed, what tells items apart: the name of an entry of the sample, or a function of the sample that
            returns an integer.

    Raises:
        KeyError: if a seed is set and the sample has no such entry.

    Convention:
        - With a seed, the state of torch's global generator is put back after each item.
        - The same item has the same draws in every epoch: give ``key=lambda sample: hash((epoch, index))`` for others.

    Example:
        >>> import kornia.augmentation as K
        >>> from kornia_tidy.augmentation import OpticsPipeline
        >>> transform = OpticsPipeline(K.RandomHorizontalFlip()).as_transform(seed=7)
        >>> sample = {"image": torch.rand(3, 64, 64), "depth": torch.ones(1, 64, 64), "index": 12}
        >>> torch.equal(transform(sample)["image"], transform(sample)["image"])
        True
    """

    def _coded(self, sample: Any, generator: torch.Generator | None = None) -> Any:
        if generator is None:
            return self.optics(sample)
        with torch.random.fork_rng():
            torch.manual_seed(generator.initial_seed())
            return self.optics(sample)
