"""What captures look like on disk: which files each item has, and which items lie together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from kornia_tidy.checks import check_choice

BESIDE = ("image", "depth", "mask")  # what may lie beside the coded image


class Part(NamedTuple):
    """What is written as a whole, or not at all."""

    name: str
    items: range


@dataclass(frozen=True)
class Layout:
    """The files of a rendered data set.

    An item has ``coded``, what is asked for beside it, and ``scene.json``: number, name, and how many pixels lay beyond
    the camera's range. It is a folder ``000123/coded.png``, or part of a shard, a tar file with members
    ``000123.coded.png``, as WebDataset reads them.

    Args:
        beside: some of ``"image"`` (the all-in-focus image), ``"depth"`` and ``"mask"`` (where depth is known).
        floats: images as float32 NPY (H, W, 3), as they are. False: PNG of 16 bits, clipped to [0, 1]. Depth is always
            a float32 NPY (H, W), as infinity belongs to it.
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
        """The maps that an item has."""
        return ("coded", *self.beside)

    def parts(self, count: int) -> list[Part]:
        """Return the folders or shards of so many items."""
        if self.shard_items is None:
            return [Part(item_key(index), range(index, index + 1)) for index in range(count)]
        size = self.shard_items
        starts = range(0, count, size)
        return [Part(f"{i:05d}.tar", range(start, min(start + size, count))) for i, start in enumerate(starts)]


def item_key(index: int) -> str:
    """Return what an item is called: its number, in six digits or more."""
    return f"{index:06d}"
