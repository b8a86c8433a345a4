"""A camera as the transform of a data set: no gradients, nothing left behind, the same noise whoever loads the item."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import chain
from typing import Any

import torch
from torch import Tensor, nn

from kornia_tidy.arrays import cropped_image, depth_tensor, image_tensor, like_image
from kornia_tidy.camera.holes import DEPTH_KEYS, filled_depth, fills_holes, names_in, with_filled
from kornia_tidy.camera.samples import with_capture
from kornia_tidy.checks import check_choice, check_positive
from kornia_tidy.optics.holes import HOLES
from kornia_tidy.render.repeatable import repeatable
from kornia_tidy.seeds import item_generator


class DatasetTransform:
    """Call a camera on single samples inside a data set. Made by ``optics.as_transform()``.

    Args:
        optics: the camera; shared, so a data set without worker processes sees what training changes.
        seed: None draws noise from torch's global generator, which differs from worker to worker. A number gives each
            item its own noise, the same for any number of workers, for fork and spawn, and in every epoch; and
            one thread takes the picture, so that its last digits are also the same.
        key: with a seed, identifies the item: the name of an entry of the sample, or a function from the sample to an
            integer.
        image_key: name of the image in a mapping.
        depth_key: name of the depth in a mapping. Default: ``"depth"`` or ``"mask_depth"``.
        depth_scale: metres in one unit of the depth; 0.001 for millimetres. Whole numbers need it; others are metres.
        holes: ``"fill"`` fills holes of the depth from the nearest known pixel, as
            :func:`kornia_tidy.data.fill_holes` does; ``"error"`` leaves them to the camera.

    Shape:
        - A tuple ``(image, depth, ...)``, or a mapping, such as a sample of MONAI or of a Hugging Face data set; a
          mapping of lists is a batch of them.
        - The image is a tensor (C, H, W), an array (H, W, C) or (H, W), or a PIL image, of floating-point, 8-bit or
          16-bit numbers, see :func:`~kornia_tidy.arrays.image_tensor`; the capture is of the same kind.
        - The depth is a tensor (1, H, W), an array (H, W) or a PIL image, and comes back as it was. Where holes are
          filled, it comes back filled, in its type, and a mapping gets ``"valid"`` of its kind, False in holes.

    Raises:
        KeyError: if a mapping has no such image or depth, or a seed is set and the sample has no such entry.
        TypeError: if the image or the depth is of another kind.
        ValueError: as the camera.

    Convention:
        A sample is moved to the camera's device, and its capture back to where the image was.

    Example:
        >>> from kornia_tidy import TiDyOptics
        >>> transform = TiDyOptics().as_transform(seed=7)
        >>> sample = {"image": torch.rand(3, 80, 80), "depth": torch.ones(1, 80, 80), "index": 12}
        >>> torch.equal(transform(sample)["image"], transform(sample)["image"])
        True
    """

    def __init__(
        self,
        optics: nn.Module,
        seed: int | None = None,
        key: str | Callable[[Any], int] = "index",
        image_key: str = "image",
        depth_key: str | None = None,
        depth_scale: float | None = None,
        holes: str = "error",
    ) -> None:
        check_positive("depth_scale", 1.0 if depth_scale is None else depth_scale, "metres per unit")
        check_choice("holes", holes, HOLES)
        self.optics = optics
        self.seed = seed
        self.key = key
        self.image_key, self.depth_key, self.depth_scale = image_key, depth_key, depth_scale
        self.holes = holes

    def __call__(self, sample: Any) -> Any:
        """Return the sample with its image coded, in the structure in which it came."""
        if isinstance(sample, Mapping) and isinstance(images := sample.get(self.image_key), list):
            singles = [self({name: entries[n] for name, entries in sample.items()}) for n in range(len(images))]
            return {name: [single[name] for single in singles] for name in (singles[0] if singles else sample)}
        with torch.no_grad():
            if self.seed is None:
                return self._coded(sample)
            generator = item_generator(self.seed, self._item(sample))
            with repeatable():
                return self._coded(sample, generator)

    def _coded(self, sample: Any, generator: torch.Generator | None = None) -> Any:
        """Return the sample with its image coded; what is no float tensor is converted to one and back."""
        options: dict[str, Any] = {} if generator is None else {"generator": generator}
        if isinstance(sample, Mapping):
            options |= {"field_center": sample["field_center"]} if "field_center" in sample else {}
            depths = DEPTH_KEYS if self.depth_key is None else (self.depth_key,)
            names = names_in(sample, self.image_key, depths, ": give image_key= and depth_key=")
            image, depth = (sample[name] for name in names)
        elif isinstance(sample, (tuple, list)) and len(sample) > 1:
            names, (image, depth) = DEPTH_KEYS, sample[:2]
        else:
            return self.optics(sample, **options)  # raises
        if fills_holes(self.optics, self.holes):
            depth, valid = filled_depth(depth)
            sample = with_filled(sample, depth, valid, names[1:])
        device = next(chain(self.optics.parameters(), self.optics.buffers()), torch.empty(0)).device
        whole = image_tensor(image)
        coded = self._capture(whole.to(device), depth_tensor(depth, self.depth_scale).to(device), **options)
        coded = coded.to(whole.device)
        margin = (whole.shape[-2] - coded.shape[-2]) // 2
        return with_capture(sample, like_image(coded, image), margin, names, cropped_image)

    def _capture(self, image: Tensor, depth: Tensor, **options: Any) -> Tensor:
        """Return the capture of an image in the image's rank."""
        return self.optics(image, depth, **options)

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
        holes = ", holes='fill'" if self.holes == "fill" else ""
        return f"{type(self).__name__}({self.optics!r}, seed={self.seed}, key={self.key!r}{holes})"
