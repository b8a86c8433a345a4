"""Scenes that are dear to make and small to keep."""

from __future__ import annotations

from typing import Any, cast

from torch import Tensor
from torch.utils.data import Dataset


class Remembered(Dataset):
    """A data set whose items are kept once they have been made, as many as fit into some memory.

    For items that follow from their index alone, such as painted scenes. Each worker of a loader remembers its own.

    Args:
        scenes: a map-style data set of mappings.
        limit: bytes of tensors that are kept; what comes later is made each time.

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
        """Return one scene: a mapping of its own, with tensors that others hold too and that nobody should change."""
        if index in self._kept:
            return dict(self._kept[index])
        item = self.scenes[index]
        size = sum(value.nbytes for value in item.values() if isinstance(value, Tensor))
        if self._bytes + size <= self.limit:
            self._kept[index] = item
            self._bytes += size
        return dict(item)
