"""What every data set of scenes gives: one mapping an item, read when it is asked for."""

from __future__ import annotations

import operator
from abc import abstractmethod
from collections.abc import Callable
from typing import Any, SupportsIndex

from torch.utils.data import Dataset

from kornia_tidy.data.rgbd import Scene

Transform = Callable[[dict[str, Any]], Any]


class UnreadableItemError(ValueError):
    """An item of a data set that cannot be read; the message names the item, its file and what is wrong with it.

    Training code catches this, and nothing wider, to skip an item.
    """


class SceneDataset(Dataset[Any]):
    """Pictures with depth, by number. Base class of the data sets of this library.

    A subclass says how many scenes there are (``__len__``), what a scene is called (:meth:`name`) and how it is read
    (:meth:`read`). Items follow from their index alone: the same in every epoch, whatever the number of workers, forked
    or spawned. No file stays open between items.

    Args:
        transform: called with each sample, for example ``optics.as_transform(seed=0)``. Default: nothing is done.

    Convention:
        An item is a mapping that :class:`~kornia_tidy.TiDyOptics` takes, and that a data loader collates:

        - ``"image"``: :math:`(3, H, W)` float32 in [0, 1], sRGB-encoded; a grey picture is repeated.
        - ``"depth"``: :math:`(1, H, W)` float32, metres, positive and maybe infinite; a normalised disparity in [0, 1],
          1 nearest, where a data set says so.
        - ``"mask"``: :math:`(1, H, W)` bool, False where depth was unknown and is filled in.
        - ``"index"``: int; ``"name"``: str.

        kornia's containers warp ``"mask"`` with the image, and what is called ``"depth"`` not at all: rename it to
        ``"mask_depth"`` first, which the camera takes as well. :class:`~kornia_tidy.data.Patches` needs no renaming.
    """

    def __init__(self, transform: Transform | None = None) -> None:
        self.transform = transform

    @abstractmethod
    def __len__(self) -> int:
        """Return the number of scenes."""

    @abstractmethod
    def name(self, index: int) -> str:
        """Return what the scene is called, without reading it."""

    @abstractmethod
    def read(self, index: int) -> Scene:
        """Read one scene; a ``ValueError`` or ``OSError`` names the file."""

    def __getitem__(self, index: SupportsIndex) -> Any:
        """Return one sample; a negative index counts from the end.

        Raises:
            IndexError: if there is no such item.
            UnreadableItemError: if its file is damaged or gone.
        """
        index = item_index(index, len(self))
        name = self.name(index)
        try:
            image, depth, valid = self.read(index)
        except (ValueError, OSError) as error:
            raise UnreadableItemError(f"item {index} of {type(self).__name__}, {name}: {error}") from error
        if image.shape[0] == 1:
            image = image.repeat(3, 1, 1)
        sample = {"image": image, "depth": depth, "mask": valid, "index": index, "name": name}
        return sample if self.transform is None else self.transform(sample)


def item_index(index: SupportsIndex, length: int) -> int:
    """Return the index as an int from 0; ``IndexError``, by which Python ends loops, if there is no such item."""
    number = operator.index(index)
    if not -length <= number < length:
        raise IndexError(f"item {number} of a data set of {length}")
    return number % length
