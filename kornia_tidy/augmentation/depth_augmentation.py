"""Augmentations that read a depth map: how depth reaches them, by a call and in kornia's containers."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Generator, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import kornia.augmentation as K
import torch
from torch import Tensor, nn

from kornia_tidy.augmentation.pipeline_transform import AugmentationTransform
from kornia_tidy.augmentation.ranges import check_probability
from kornia_tidy.augmentation.rows import changed_rows, outside_graphs
from kornia_tidy.camera.holes import fills_holes
from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.checks import check_choice, check_float_tensor, check_part
from kornia_tidy.optics.holes import HOLES, fill_holes
from kornia_tidy.optics.units import check_depth_fits

_PIXELWISE = ("kornia.color", "kornia.enhance", "kornia.filters")  # packages whose modules move no pixel
HALVES = (torch.float16, torch.bfloat16)


class DepthTap(K.IntensityAugmentationBase2D):
    """Hand the depth that a container has warped to the augmentation that follows. Changes neither image nor depth.

    ``AugmentationSequential`` calls each child with the image and then with the masks. The tap keeps the mask until the
    next child, the augmentation that the tap belongs to, asks for it: ``augmentation.depth_tap``.

    Args:
        mask: which of the container's masks is the depth, if it has several: 0 for the first. None: there is one.

    Raises:
        ValueError: when the augmentation asks, if the mask is missing, if there are several and none is named, if depth
            came in half precision, or if another child stands between tap and augmentation.

    Example:
        >>> import kornia.augmentation as K
        >>> from kornia_tidy.augmentation import RandomDepthBlur
        >>> blur = RandomDepthBlur(p=1.0)
        >>> flip = K.RandomHorizontalFlip()
        >>> chain = K.AugmentationSequential(flip, blur.depth_tap, blur, data_keys=["input", "mask"])
        >>> image, depth = chain(torch.rand(2, 3, 32, 32), torch.ones(2, 1, 32, 32))
        >>> image.shape, depth.shape
        (torch.Size([2, 3, 32, 32]), torch.Size([2, 1, 32, 32]))
    """

    def __init__(self, mask: int | None = None) -> None:
        super().__init__(p=1.0)
        self.mask = mask
        self.image: Tensor | None = None
        self.version = 0
        self.masks: list[Tensor] = []

    def apply_transform(
        self, input: Tensor, params: dict[str, Tensor], flags: dict[str, Any], transform: Tensor | None = None
    ) -> Tensor:
        """Return the image unchanged, and forget the masks of the call before."""
        self.image, self.version, self.masks = input, input._version, []
        return input

    def apply_transform_mask(
        self, input: Tensor, params: dict[str, Tensor], flags: dict[str, Any], transform: Tensor | None = None
    ) -> Tensor:
        """Return the mask unchanged, and keep it for the next child."""
        self.masks.append(input)
        return input

    def __getstate__(self) -> dict[str, Any]:
        """Return what travels with pickle and deepcopy: no image and no depth."""
        return {**super().__getstate__(), "image": None, "masks": []}

    def take(self, image: Tensor, name: str) -> Tensor:
        """Return the depth of an image, once.

        Args:
            image: (B, C, H, W), as the augmentation got it.
            name: of the augmentation, for messages.
        """
        seen, masks = self.image, self.masks
        self.image, self.masks = None, []
        if seen is None or not masks:
            raise ValueError(
                f"{name} got no depth: call it as augmentation(image, depth), put augmentation.depth_tap before it in "
                f"an AugmentationSequential that is given the depth under the key 'mask' or 'mask_depth' ('depth' "
                f"passes unwarped), or use OpticsPipeline or bound_depth"
            )
        same = seen.shape == image.shape and seen.data_ptr() == image.data_ptr() and image._version == self.version
        if not same:
            raise ValueError(
                f"{name} must directly follow its depth_tap, got an image that was changed between the two: the depth "
                f"may no longer fit it"
            )
        if self.mask is None and len(masks) > 1:
            raise ValueError(
                f"{len(masks)} masks reach {name}: tell which of them is the depth with "
                f"augmentation.depth_tap.mask = 0 for the first"
            )
        chosen = self.mask or 0
        if not 0 <= chosen < len(masks):
            raise ValueError(
                f"augmentation.depth_tap.mask must be from 0 to {len(masks) - 1} for {len(masks)} masks, got {chosen}"
            )
        depth = masks[chosen]
        if depth.dtype in HALVES:
            raise ValueError(
                f"depth reaches {name} in {depth.dtype}, since the container casts masks to the image's type: give "
                f"the image in float32, or use OpticsPipeline"
            )
        return depth


class DepthAugmentation(K.IntensityAugmentationBase2D):
    """Base class of intensity augmentations that read a depth map. A subclass implements :meth:`change`.

    Rows that the draw leaves out are not computed.

    Args:
        same_on_batch: one draw for the whole batch.
        p: probability of each image to be changed.
        keepdim: return (C, H, W) for (C, H, W).
        holes: ``"fill"`` fills holes of the depth of the images that are changed; ``"error"`` refuses them.

    Raises:
        TypeError: if ``p`` is not a number.
        ValueError: if ``p`` is not from 0 to 1, or ``holes`` is another word.

    Shape:
        - ``augmentation(image, depth)``: (B, C, H, W) and (B, 1, H, W) or (1, 1, H, W), or both without B.
        - ``augmentation(image)`` inside a container: behind ``augmentation.depth_tap``, or with :func:`bound_depth`.

    Convention:
        - A container of kornia returns the depth with its holes, warped with it. Fill
          them behind it: ``depth, valid = kornia_tidy.data.fill_holes(depth)``.
    """

    def __init__(
        self, same_on_batch: bool = False, p: float = 0.5, keepdim: bool = False, holes: str = "error"
    ) -> None:
        check_probability(p)
        check_choice("holes", holes, HOLES)
        super().__init__(p=p, same_on_batch=same_on_batch, keepdim=keepdim)
        self.holes = holes
        self.depth_tap = DepthTap()
        self.bound: Tensor | None = None  # while a call or bound_depth lasts

    @abstractmethod
    def change(self, image: Tensor, depth: Tensor, params: Mapping[str, Tensor]) -> Tensor:
        """Return the changed images of some rows of the batch.

        Args:
            image: (B', C, H, W).
            depth: (B', 1, H, W) or (1, 1, H, W), float32 or float64.
            params: the draws of these rows, each (B', ...).
        """

    def forward(  # ty: ignore[incompatible-method-override]
        self, input: Tensor, depth: Tensor | None = None, params: dict[str, Tensor] | None = None, **kwargs: Any
    ) -> Tensor:
        """Change images at random.

        Args:
            input: (B, C, H, W) or (C, H, W).
            depth: (B, 1, H, W), (1, 1, H, W) or (1, H, W). None inside a container.
            params: an earlier draw, such as ``augmentation._params``, to be repeated.
            kwargs: as kornia's containers give them.

        Raises:
            TypeError: if the image is a sample of several parts, or the depth is not a floating-point tensor.
            ValueError: if the depth is missing, or it does not fit.
        """
        if not isinstance(input, Tensor):
            raise TypeError(
                f"{type(self).__name__} takes tensors as (image, depth), got a {type(input).__name__}: OpticsPipeline "
                f"takes tuples and mappings"
            )
        if not input.is_floating_point():
            raise TypeError(
                f"image must be floating point in [0, 1], got {input.dtype}: divide it by the largest value of its "
                f"type, or use as_transform(), which takes 8 and 16 bits"
            )
        count = 1 if input.ndim == 3 else len(input)
        if params is not None and (drawn := params.get("batch_prob")) is not None and len(drawn) != count:
            raise ValueError(
                f"params must be the draw of a batch of {count}, as the image is, got that of {len(drawn)}"
            )
        if depth is None:
            return super().forward(input, params=params, **kwargs)
        check_float_tensor("depth", depth, input.ndim, "(B, 1, H, W) or (1, H, W), as the image is batched or not")
        before, self.bound = self.bound, depth
        try:
            return super().forward(input, params=params, **kwargs)
        finally:
            self.bound = before

    def as_transform(self, seed: int | None = None, key: Any = "index", **entries: Any) -> AugmentationTransform:
        """Return the augmentation as a transform of single samples. See :class:`AugmentationTransform`.

        Args:
            seed: gives each item its own draws, the same for any number of workers.
            key: the entry that tells items apart, or a function of the sample.
            entries: ``image_key=``, ``depth_key=``, ``depth_scale=`` and ``holes=``.
        """
        return AugmentationTransform(self, seed, key, **entries)

    @outside_graphs  # which rows are computed depends on values
    def apply_transform(
        self, input: Tensor, params: dict[str, Tensor], flags: dict[str, Any], transform: Tensor | None = None
    ) -> Tensor:
        """Return the images, those changed that the draw names."""
        depth = self._depth_of(input)

        def change(rows: Tensor | slice, drawn: dict[str, Tensor]) -> Tensor:
            seen = depth if depth.shape[0] == 1 else depth[rows]
            return self.change(input[rows], fill_holes(seen)[0] if fills_holes(self, self.holes) else seen, drawn)

        # kornia does not look at batch_prob where p is 1
        return changed_rows(input, params, self.p == 1 and self.p_batch == 1, change)

    def _depth_of(self, image: Tensor) -> Tensor:
        depth = self.depth_tap.take(image, type(self).__name__) if self.bound is None else self.bound
        check_float_tensor("depth", depth, depth.ndim, "(B, 1, H, W)")
        depth = depth[None] if depth.ndim == 3 else depth
        check_depth_fits(depth, image)
        return depth.to(image.device, torch.promote_types(depth.dtype, torch.float32))

    def __getstate__(self) -> dict[str, Any]:
        """Return what travels with pickle and deepcopy: no depth."""
        return {**super().__getstate__(), "bound": None}


def checked_optics(optics: nn.Module | None) -> nn.Module:
    """Return the camera or the augmentation that takes an adapter's captures; a default camera for None.

    Raises:
        TypeError: if it is neither.
        ValueError: if its border crops the image, which the other entries of a sample would not follow.

    Example:
        >>> checked_optics(None).border
        'reflect'
    """
    optics = TiDyOptics() if optics is None else optics
    check_part("optics", optics, (TiDyOptics, DepthAugmentation), "TiDyOptics or an augmentation that reads depth")
    if getattr(camera_of(optics), "border", None) == "valid":
        raise ValueError("border 'valid' crops the image and not the other entries of a sample: use another border")
    return optics


def camera_of(optics: nn.Module) -> TiDyOptics | None:
    """Return a camera, or that of an augmentation; None if it has none."""
    camera = optics if isinstance(optics, TiDyOptics) else getattr(optics, "optics", None)
    return camera if isinstance(camera, TiDyOptics) else None


@contextmanager
def bound_depth(container: nn.Module, depth: Tensor) -> Generator[None]:
    """Give a depth map to the augmentations in a container that passes on only the image.

    Args:
        container: ``ImageSequential``, ``VideoSequential`` or ``nn.Sequential`` with augmentations that read depth.
        depth: (B, 1, H, W), (1, 1, H, W) or (1, H, W); for a video (B, T, 1, H, W) or (B, 1, T, H, W), as the
            container's ``data_format`` has it, one map for each frame.

    Raises:
        ValueError: if no augmentation in the container reads depth, or a child may move pixels: the depth would not
            move with them.

    Convention:
        - A geometric child is refused wherever it stands. :class:`~kornia_tidy.augmentation.OpticsPipeline` warps image
          and depth together.

    Example:
        >>> import kornia.augmentation as K
        >>> from kornia_tidy.augmentation import RandomDepthBlur
        >>> chain = K.ImageSequential(K.ColorJiggle(0.1, 0.1, 0.1, 0.1), RandomDepthBlur(p=1.0))
        >>> with bound_depth(chain, torch.ones(2, 1, 32, 32)):
        ...     chain(torch.rand(2, 3, 32, 32)).shape
        torch.Size([2, 3, 32, 32])
    """
    leaves = list(container_leaves(container))
    readers = [leaf for leaf in leaves if isinstance(leaf, DepthAugmentation)]
    if not readers:
        raise ValueError(f"no augmentation in {type(container).__name__} reads a depth map")
    for leaf in leaves:
        if moves_pixels(leaf):
            raise ValueError(
                f"{type(leaf).__name__} may move pixels, and a bound depth does not move with them: use "
                f"OpticsPipeline, or an AugmentationSequential with the depth as a mask"
            )
    before = [reader.bound for reader in readers]
    for reader in readers:
        reader.bound = depth_of_frames(container, depth)
    try:
        yield
    finally:
        for reader, bound in zip(readers, before, strict=True):
            reader.bound = bound


def moves_pixels(module: nn.Module) -> bool:
    """Return whether a module may move pixels: True unless it is known to leave them in place.

    Example:
        >>> moves_pixels(K.RandomHorizontalFlip()), moves_pixels(K.ColorJiggle(0.1)), moves_pixels(nn.Identity())
        (True, False, False)
    """
    if isinstance(module, (K.IntensityAugmentationBase2D, nn.Identity)):
        return False
    return not type(module).__module__.startswith(_PIXELWISE)


def depth_of_frames(container: nn.Module, depth: Tensor) -> Tensor:
    """Return the depth of a video as that of a batch of frames, (B T, 1, H, W); other depths unchanged.

    Args:
        container: its ``data_format`` tells which axis is time.
        depth: (B, T, 1, H, W) or (B, 1, T, H, W).
    """
    if depth.ndim != 5:
        return depth
    if not isinstance(container, K.VideoSequential):
        raise ValueError(f"depth of a video is for a VideoSequential, got {tuple(depth.shape)}")
    return (depth.transpose(1, 2) if container.data_format == "BCTHW" else depth).flatten(0, 1)


def container_leaves(container: nn.Module) -> Iterator[nn.Module]:
    """Yield the modules that a container calls, and those of the containers in it."""
    if isinstance(container, (K.ImageSequential, nn.Sequential, nn.ModuleList)) and not isinstance(
        container, K.PatchSequential
    ):
        for child in container.children():
            yield from container_leaves(child)
    else:
        yield container
