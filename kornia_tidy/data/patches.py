"""Patches: crops of one size, with the same window for image, depth and mask."""

from __future__ import annotations

from collections.abc import Sized
from typing import Any, SupportsIndex

import torch
from torch import Tensor
from torch.utils.data import Dataset

from kornia_tidy.data.scene_dataset import Transform, UnreadableItemError, item_index
from kornia_tidy.seeds import item_generator


class Patches(Dataset[Any]):
    """Data set of random patches, with scenes and places that depend only on the seed and the index.

    Args:
        scenes: a map-style data set of mappings with an ``"image"``: one of this library, or a ``Subset``.
        size: side of a patch in pixels, or (height, width).
        count: number of patches. Up to ``len(scenes)`` all are from different scenes, in an order drawn by the seed;
            after that scenes are used again, with other windows. Default: one per scene.
        seed: of the windows and of the order of scenes.
        transform: called with each patch. A camera belongs here: as a transform of ``scenes`` it would also photograph
            the pixels that are cropped away.

    Raises:
        ValueError: if there are no scenes, or a size or the count is not positive.
        UnreadableItemError: from an item, if its scene cannot be read or is smaller than the patch.

    Convention:
        - ``"index"`` is the number of the patch; ``"name"`` is that of the scene with the top left corner,
          ``"TRAIN/A/0000/left/0006@131,402"`` for row 131 and column 402.
        - Every tensor of the sample with the height and width of the image is cropped.

    Example:
        >>> from kornia_tidy.data.dead_leaves import DeadLeaves
        >>> patches = Patches(DeadLeaves(3, 40, 60, num_leaves=50), size=32, count=5)
        >>> len(patches), patches[4]["image"].shape, patches[4]["mask"].shape
        (5, torch.Size([3, 32, 32]), torch.Size([1, 32, 32]))
        >>> torch.equal(patches[4]["depth"], patches[4]["depth"])
        True
    """

    def __init__(
        self,
        scenes: Dataset[Any],
        size: int | tuple[int, int],
        count: int | None = None,
        *,
        seed: int = 0,
        transform: Transform | None = None,
    ) -> None:
        if not isinstance(scenes, Sized) or not len(scenes):
            raise ValueError(f"patches need a data set with at least one scene, got {scenes!r}")
        self.scenes = scenes
        self.size = _height_width(size)
        self.count = len(scenes) if count is None else count
        if self.count < 1:
            raise ValueError(f"count must be a positive number of patches, got {count}")
        self.seed = seed
        self.transform = transform
        # Patch i has generator i, and the order of scenes generator -1.
        self.order = torch.randperm(len(scenes), generator=item_generator(seed, -1)).tolist()

    def __len__(self) -> int:
        """Return the number of patches."""
        return self.count

    def __getitem__(self, index: SupportsIndex) -> Any:
        """Return one patch; a negative index counts from the end."""
        index = item_index(index, self.count)
        try:
            sample = self.scenes[self.order[index % len(self.order)]]
            patch, corner = _random_crop(sample, self.size, item_generator(self.seed, index))
        except ValueError as error:
            raise UnreadableItemError(f"patch {index}: {error}") from error
        patch |= {"index": index, "name": f"{sample.get('name', 'scene')}@{corner[0]},{corner[1]}"}
        return patch if self.transform is None else self.transform(patch)


def random_crop(
    sample: dict[str, Any], size: int | tuple[int, int], generator: torch.Generator | None = None
) -> dict[str, Any]:
    """Crop all maps of a sample to the same random window.

    Args:
        sample: a mapping with an ``"image"`` :math:`(..., H, W)`.
        size: side of the window in pixels, or (height, width).
        generator: of the window. Default: torch's global generator.

    Returns:
        A new mapping with a cropped copy of every tensor that has the height and width of the image; all other
        entries are passed on.

    Raises:
        KeyError: if the image is missing.
        ValueError: if the window is larger than the image.

    Example:
        >>> sample = {"image": torch.rand(3, 9, 9), "depth": torch.ones(1, 9, 9), "index": 4}
        >>> cut = random_crop(sample, (5, 7))
        >>> cut["image"].shape, cut["depth"].shape, cut["index"]
        (torch.Size([3, 5, 7]), torch.Size([1, 5, 7]), 4)
    """
    return _random_crop(sample, _height_width(size), generator)[0]


def central_crop(sample: dict[str, Any], size: int | tuple[int, int]) -> dict[str, Any]:
    """Crop all maps of a sample to the window in the middle. See :func:`random_crop`.

    Example:
        >>> central_crop({"image": torch.arange(25).view(1, 5, 5)}, (1, 3))["image"]
        tensor([[[11, 12, 13]]])
    """
    height, width = _height_width(size)
    image_height, image_width = _fitting((height, width), sample)
    return crop(sample, (image_height - height) // 2, (image_width - width) // 2, height, width)


def crop(sample: dict[str, Any], top: int, left: int, height: int, width: int) -> dict[str, Any]:
    """Crop all maps of a sample to the window at row ``top`` and column ``left``. See :func:`random_crop`.

    Raises:
        KeyError: if the image is missing.
        ValueError: if the window does not lie inside the image.
    """
    size = sample["image"].shape[-2:]
    if not (0 <= top <= top + height <= size[0] and 0 <= left <= left + width <= size[1]):
        raise ValueError(
            f"a window of {height} x {width} pixels at row {top}, column {left} does not lie inside an image of "
            f"{size[0]} x {size[1]}"
        )
    window = (..., slice(top, top + height), slice(left, left + width))
    return {
        key: value[window].clone() if isinstance(value, Tensor) and value.shape[-2:] == size else value
        for key, value in sample.items()
    }


def _random_crop(
    sample: dict[str, Any], size: tuple[int, int], generator: torch.Generator | None
) -> tuple[dict[str, Any], tuple[int, int]]:
    height, width = _fitting(size, sample)
    top = int(torch.randint(height - size[0] + 1, (), generator=generator))
    left = int(torch.randint(width - size[1] + 1, (), generator=generator))
    return crop(sample, top, left, *size), (top, left)


def _fitting(size: tuple[int, int], sample: dict[str, Any]) -> tuple[int, int]:
    """Return height and width of a sample; raise ``ValueError`` if a patch does not fit."""
    height, width = sample["image"].shape[-2:]
    if size[0] > height or size[1] > width:
        raise ValueError(f"a patch of {size[0]} x {size[1]} pixels does not fit into an image of {height} x {width}")
    return height, width


def _height_width(size: int | tuple[int, int]) -> tuple[int, int]:
    height, width = (size, size) if isinstance(size, int) else size
    if height < 1 or width < 1:
        raise ValueError(f"size must be a positive number of pixels or (height, width), got {size}")
    return height, width
