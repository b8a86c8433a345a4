"""Cache of the items of a data set in memory."""

from __future__ import annotations

from typing import Any, cast

from torch import Tensor
from torch.utils.data import Dataset


class Remembered(Dataset):
    """Data set that caches the items of another one, up to a limit of memory.

    For items that depend only on their index, such as painted scenes. Each worker of a loader has its own cache.

    Args:
        scenes: a map-style data set of mappings.
        limit: largest size of all cached tensors in bytes; further items are not cached.

    Example:
        >>> from kornia_tidy.data.dead_leaves import DeadLeaves
        >>> scenes = Remembered(DeadLeaves(100, 32, 32, num_leaves=20))
        >>> scenes[3]["image"] is scenes[3]["image"]
        True
    """

    def __init__(self, scenes: Dataset, limit: int = 1 << 30) -> None:
        self.scenes, self.limit = scenes, limit
        self._kept: dict[int, dict[str, Any]] = {}
        self._bytes = 0

    def __len__(self) -> int:
        """Return the number of scenes."""
        return len(cast("Any", self.scenes))

    def __getitem__(self, index: int) -> dict[str, Any]:
        """Return one scene: a new mapping of cached tensors, which must not be changed."""
        if index in self._kept:
            return dict(self._kept[index])
        item = self.scenes[index]
        size = sum(value.nbytes for value in item.values() if isinstance(value, Tensor))
        if self._bytes + size <= self.limit:
            self._kept[index] = item
            self._bytes += size
        return dict(item)
