"""Base class of data sets of scenes: items are mappings of image, depth and mask, read on access."""

from __future__ import annotations

import operator
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, SupportsIndex

from torch.utils.data import Dataset

from kornia_tidy.data.rgbd import Scene

Transform = Callable[[dict[str, Any]], Any]


class UnreadableItemError(ValueError):
    """Error of an unreadable item of a data set; the message names the item, its file and the fault.

    Training code can skip an item by catching this error.
    """


class SceneDataset(Dataset[Any]):
    """Base class of the data sets of scenes.

    A subclass sets ``names``, the name of each scene, and defines how one is read (:meth:`read`). Items depend only on
    their index: they are the same in every epoch and for any number of workers, forked or spawned. No file stays open
    between items.

    Args:
        transform: called with each sample, for example ``optics.as_transform(seed=0)``. Default: samples are
            returned unchanged.

    Convention:
        An item is a mapping that :class:`~kornia_tidy.TiDyOptics` takes and a data loader collates:

        - ``"image"``: :math:`(3, H, W)` float32 in [0, 1], sRGB-encoded; a grey picture is repeated.
        - ``"depth"``: :math:`(1, H, W)` float32, metres, positive and maybe infinite; for some data sets a normalised
          disparity in [0, 1], 1 nearest.
        - ``"mask"``: :math:`(1, H, W)` bool, False where depth was unknown and is filled in.
        - ``"index"``: int; ``"name"``: str.

        kornia's containers transform ``"mask"`` like the image, but not ``"depth"``: rename it to ``"mask_depth"``
        before, which the camera also takes. :class:`~kornia_tidy.data.Patches` needs no renaming.
    """

    def __init__(self, transform: Transform | None = None) -> None:
        self.transform = transform

    names: Sequence[str] = ()
    """Of the scenes, known without reading them."""

    def __len__(self) -> int:
        """Return the number of scenes."""
        return len(self.names)

    def name(self, index: int) -> str:
        """Return the name of a scene."""
        return self.names[index]

    @abstractmethod
    def read(self, index: int) -> Scene:
        """Read one scene; raise ``ValueError`` or ``OSError`` with the name of the file if it cannot be read."""

    def __getitem__(self, index: SupportsIndex) -> Any:
        """Return one sample; a negative index counts from the end.

        Raises:
            IndexError: if the index is out of range.
            UnreadableItemError: if its file is damaged or missing.
        """
        index = item_index(index, len(self))
        name = self.name(index)
        try:
            image, depth, valid = self.read(index)
        except (ValueError, OSError) as error:
            raise UnreadableItemError(f"item {index} of {type(self).__name__}, {name:.100}: {error!s:.500}") from error
        if image.shape[0] == 1:
            image = image.repeat(3, 1, 1)
        sample = {"image": image, "depth": depth, "mask": valid, "index": index, "name": name}
        return sample if self.transform is None else self.transform(sample)


def item_index(index: SupportsIndex, length: int) -> int:
    """Return the index as an int from 0; raise ``IndexError``, which ends Python's loops, if it is out of range."""
    number = operator.index(index)
    if not -length <= number < length:
        raise IndexError(f"item {number} of a data set of {length}")
    return number % length
