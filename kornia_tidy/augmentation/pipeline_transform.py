"""Augmentations and pipelines as transforms of a data set: the same draws for an item, whoever loads it."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from kornia_tidy.camera.dataset_transform import DatasetTransform
from kornia_tidy.psf.field import check_centers


class PipelineTransform(DatasetTransform):
    """Call a pipeline on single samples inside a data set. Made by ``pipeline.as_transform()``.

    Args:
        optics: the pipeline.
        seed: None draws from the global generator of torch, which differs from worker to worker. A number gives each
            item its own draws, the same for any number of workers, for fork and spawn, and in every epoch.
        key: with a seed, identifies the item: the name of an entry of the sample, or a function from the sample to an
            integer.

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


class AugmentationTransform(DatasetTransform):
    """Call an augmentation that reads depth on single samples of a data set. Made by ``augmentation.as_transform()``.

    Arguments, samples and errors are those of :class:`~kornia_tidy.camera.dataset_transform.DatasetTransform`: images
    of 8 or 16 bits, arrays and PIL images, and depth in whole numbers with its ``depth_scale``.

    Convention:
        - With a seed, the state of torch's global generator is put back after each item.

    Example:
        >>> from kornia_tidy.augmentation import RandomDepthBlur
        >>> transform = RandomDepthBlur(p=1.0).as_transform(seed=7, depth_scale=0.001)
        >>> millimetres = torch.full((1, 48, 48), 900, dtype=torch.int32)
        >>> sample = {"image": torch.zeros(3, 48, 48, dtype=torch.uint8), "depth": millimetres, "index": 12}
        >>> transform(sample)["image"].dtype
        torch.uint8
    """

    def _capture(self, image: Tensor, depth: Tensor, **options: Any) -> Tensor:
        generator, field_center = options.get("generator"), options.get("field_center")
        with torch.random.fork_rng(enabled=generator is not None):
            if generator is not None:
                torch.manual_seed(generator.initial_seed())
            params = None if field_center is None else draws_at(self.optics, image, field_center)
            coded = self.optics(image, depth, params=params)
        return coded[0] if coded.ndim > image.ndim else coded


def draws_at(augmentation: Any, image: Tensor, place: Any) -> dict[str, Any]:
    """Return random draws of an augmentation behind a lens for pictures at a given place in its field.

    Args:
        augmentation: that of the camera.
        image: (B, C, H, W) or (C, H, W).
        place: y and x of each picture's middle in sensor pixels from the axis, (2,) or (B, 2).
    """
    shape = image.shape if image.ndim == 4 else (1, *image.shape)
    centers = torch.tensor(check_centers(place, shape[0]), dtype=torch.float64)
    return augmentation.forward_parameters(shape) | {"field_center": centers.expand(shape[0], 2)}
