"""Data set of stored captures, for training."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, SupportsIndex

from torch.utils.data import Dataset

from kornia_tidy.data.scene_dataset import UnreadableItemError, item_index
from kornia_tidy.training.coded_datasets.index import read_index, read_place
from kornia_tidy.training.coded_datasets.item_files import decode_map


class CodedCaptures(Dataset[dict[str, Any]]):
    """Data set of the captures that ``kornia-tidy render`` or :func:`render_scenes` wrote, in folders or shards.

    Args:
        root: the folder.

    Raises:
        FileNotFoundError: if the folder has no index, which is written after the last capture.
        ValueError: if the index is damaged.

    Convention:
        - An item is ``{"coded", "image", "depth", "mask", "index", "name"}``, without the maps that were not stored:
          images (3, H, W) float32, depth (1, H, W) float32 in metres, the mask (1, H, W) bool, False where depth was
          unknown and is filled in.
        - No file stays open between items, so that workers of a data loader, forked or spawned, can read it.

    Example:
        >>> import tempfile, torch
        >>> from kornia_tidy import TiDyOptics
        >>> from kornia_tidy.data.dead_leaves import DeadLeaves
        >>> from kornia_tidy.training.coded_datasets.layout import Layout
        >>> from kornia_tidy.training.coded_datasets import render_scenes
        >>> scenes, folder = DeadLeaves(3, 64, 64, num_leaves=100), tempfile.TemporaryDirectory()
        >>> render_scenes(TiDyOptics(), scenes, folder.name, Layout(shard_items=2))
        Rendered(made=3, found=0)
        >>> loader = torch.utils.data.DataLoader(CodedCaptures(folder.name), batch_size=3)
        >>> {name: tuple(values.shape) for name, values in next(iter(loader)).items() if name in ("coded", "depth")}
        {'coded': (3, 3, 64, 64), 'depth': (3, 1, 64, 64)}
        >>> folder.cleanup()
    """

    def __init__(self, root: str | os.PathLike[str]) -> None:
        self.root = Path(root)
        self._entries = read_index(self.root)
        self._fields = [name for name in self._entries[0] if name not in ("key", "name", "clamped_pixels")]

    def __len__(self) -> int:
        """Return the number of captures."""
        return len(self._entries)

    def name(self, index: int) -> str:
        """Return the name of the scene of a capture."""
        return self._entries[index]["name"]

    def __getitem__(self, index: SupportsIndex) -> dict[str, Any]:
        """Return one capture; a negative index counts from the end.

        Raises:
            IndexError: if the index is out of range.
            UnreadableItemError: if one of its files is damaged or missing.
        """
        index = item_index(index, len(self))
        entry = self._entries[index]
        try:
            maps = {
                field: decode_map(field, read_place(self.root, entry[field]), f"{self.root}/{entry[field]}")
                for field in self._fields
            }
        except (ValueError, OSError) as error:
            raise UnreadableItemError(f"capture {entry['key']}, {entry['name']:.100}: {error!s:.500}") from error
        return {**maps, "index": index, "name": entry["name"]}
