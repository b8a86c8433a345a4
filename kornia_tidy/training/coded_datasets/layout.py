"""Layout of captures on disk: the files of an item, and folders or shards of items."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from kornia_tidy.checks import check_choice

BESIDE = ("image", "depth", "mask")  # optional maps beside the coded image


class Part(NamedTuple):
    """A folder or shard, which is written atomically, and its items."""

    name: str
    items: range


@dataclass(frozen=True)
class Layout:
    """Files of a coded data set.

    An item has ``coded``, the maps ``beside`` it, and ``scene.json`` with its number, its name, and the number of
    pixels beyond the camera's range of depth. It is a folder, with files such as ``000123/coded.png``, or part of a
    shard: a tar file with members such as ``000123.coded.png``, the format of WebDataset.

    Args:
        beside: some of ``"image"`` (the all-in-focus image), ``"depth"`` and ``"mask"`` (where depth is known).
        floats: store images as float32 NPY (H, W, 3), unclipped. False: as 16-bit PNG, clipped to [0, 1]. Depth is
            always a float32 NPY (H, W), as it may be infinite.
        shard_items: items in a shard. None: a folder for each item.

    Raises:
        ValueError: if a value is not allowed.

    Example:
        >>> layout = Layout(beside=("depth",), shard_items=1000)
        >>> layout.fields, layout.parts(2500)[-1]
        (('coded', 'depth'), Part(name='00002.tar', items=range(2000, 2500)))
    """

    beside: tuple[str, ...] = BESIDE
    floats: bool = False
    shard_items: int | None = None

    def __post_init__(self) -> None:
        for name in self.beside:
            check_choice("what lies beside a capture", name, BESIDE)
        object.__setattr__(self, "beside", tuple(name for name in BESIDE if name in self.beside))
        if self.shard_items is not None and self.shard_items < 1:
            raise ValueError(f"a shard must hold 1 item or more, got {self.shard_items}")

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of the maps of an item."""
        return ("coded", *self.beside)

    def parts(self, count: int) -> list[Part]:
        """Return the folders or shards of a number of items."""
        if self.shard_items is None:
            return [Part(item_key(index), range(index, index + 1)) for index in range(count)]
        size = self.shard_items
        starts = range(0, count, size)
        return [Part(f"{i:05d}.tar", range(start, min(start + size, count))) for i, start in enumerate(starts)]


def item_key(index: int) -> str:
    """Return the key of an item: its number in six digits or more."""
    return f"{index:06d}"
