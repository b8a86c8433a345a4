"""A camera as the transform of a data set: no gradients, nothing left behind, the same noise whoever loads the item."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import nn

from kornia_tidy.render.repeatable import repeatable


class DatasetTransform:
    """Call a camera on single samples inside a data set. Made by ``optics.as_transform()``.

    Args:
        optics: the camera; shared, so a data set without worker processes sees what training changes.
        seed: None draws noise from torch's global generator, which differs from worker to worker. A number gives each
            item its own noise, the same for any number of workers, for fork and spawn, and in every epoch; and
            one thread takes the picture, by the shipped cost profile, so that its last digits are the same too.
        key: with a seed, what tells items apart: the name of an entry of the sample, or a function of the sample that
            returns an integer.

    Raises:
        KeyError: if a seed is set and the sample has no such entry.

    Example:
        >>> from kornia_tidy import TiDyOptics
        >>> transform = TiDyOptics().as_transform(seed=7)
        >>> sample = {"image": torch.rand(3, 80, 80), "depth": torch.ones(1, 80, 80), "index": 12}
        >>> torch.equal(transform(sample)["image"], transform(sample)["image"])
        True
    """

    def __init__(self, optics: nn.Module, seed: int | None = None, key: str | Callable[[Any], int] = "index") -> None:
        self.optics = optics
        self.seed = seed
        self.key = key

    def __call__(self, sample: Any) -> Any:
        """Return the sample with its image coded, in the structure in which it came."""
        with torch.no_grad():
            if self.seed is None:
                return self.optics(sample)
            generator = item_generator(self.seed, self._item(sample))
            with repeatable():
                return self.optics(sample, generator=generator)

    def _item(self, sample: Any) -> int:
        if not isinstance(self.key, str):
            return int(self.key(sample))
        if not isinstance(sample, Mapping) or self.key not in sample:
            have = list(sample) if isinstance(sample, Mapping) else type(sample).__name__
            raise KeyError(
                f"a seeded transform tells items apart by sample[{self.key!r}], and this sample has {have}: add the "
                f"item's index to the sample, or pass key=a function of the sample"
            )
        return int(sample[self.key])

    def __repr__(self) -> str:
        return f"DatasetTransform({self.optics!r}, seed={self.seed}, key={self.key!r})"


def item_generator(seed: int, item: int) -> torch.Generator:
    """Return a generator that depends on a seed and an item's number only; neighbours are unrelated.

    Example:
        >>> int(torch.randint(100, (1,), generator=item_generator(0, 1)))
        33
    """
    digest = hashlib.sha256(f"{seed}/{item}".encode()).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest[:8], "little", signed=True))
