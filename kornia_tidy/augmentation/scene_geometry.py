"""Geometric augmentations of a scene: image, depth and the mask of valid depth are warped together."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple, cast

import kornia.augmentation as K
import torch
from kornia.augmentation.container.base import ImageSequentialBase
from kornia.constants import DataKey
from torch import Tensor, nn

from kornia_tidy.augmentation.depth_augmentation import DepthAugmentation, DepthTap, container_leaves, moves_pixels
from kornia_tidy.checks import check_float_tensor, check_values
from kornia_tidy.optics.holes import fill_holes
from kornia_tidy.psf.field import check_centers

KNOWN = tuple(DataKey.__members__)
_DEPTH, _VALID = "mask_of_depth", "mask_of_valid_depth"


class Scene(NamedTuple):
    """Warped scene: image, depth, mask of valid depth, and further entries."""

    image: Tensor
    """(B, C, H, W)."""
    depth: Tensor
    """(B, 1, H, W), positive: holes have the value of the nearest valid pixel."""
    valid: Tensor
    """(B, 1, H, W) bool, False in holes."""
    others: dict[str, Any]
    """Masks, boxes and keypoints by their names."""


class SceneGeometry(nn.Module):
    r"""Warp images and their depth by the same geometric augmentations of kornia.

    Depth is resampled by the nearest pixel, so that no depth between two things arises. Pixels from beyond the image,
    as at the corners of a rotation, are holes: filled from the nearest valid pixel, and False in the mask.

    Args:
        augmentations: of kornia, one after another, or one ``AugmentationSequential``.
        scale_depth: divide the depth by the magnification of the warp. An image that is enlarged by s looks as if taken
            from s times nearer; without this it is a crop of the same picture.

    Shape:
        - ``geometry(image, depth, valid=None)`` to a :class:`Scene`; each input batched, or all without B.

    Raises:
        TypeError: if an augmentation is not a module of kornia's that warps masks with the image.
        ValueError: if masks would be interpolated, or, on use, ``scale_depth`` meets a warp that is not affine, or a
            whole map of depth is left without a valid pixel.

    Convention:
        - Depth is warped in float32 or better, whatever the image's type, and has its own type at the end.
        - Draws are kornia's. :attr:`params` holds the last ones, for ``params=``.

    Example:
        >>> import kornia.augmentation as K
        >>> geometry = SceneGeometry(K.RandomRotation((30.0, 30.0), p=1.0))
        >>> scene = geometry(torch.rand(2, 3, 32, 32), torch.ones(2, 1, 32, 32))
        >>> scene.depth.min(), bool(scene.valid.all())
        (tensor(1.), False)
    """

    def __init__(self, *augmentations: nn.Module, scale_depth: bool = False) -> None:
        super().__init__()
        for leaf in (leaf for augmentation in augmentations for leaf in container_leaves(augmentation)):
            if isinstance(leaf, (DepthAugmentation, DepthTap)):
                raise TypeError(f"{type(leaf).__name__} is optics and belongs behind the geometry")
            if isinstance(leaf, K.MixAugmentationBaseV2) or (moves_pixels(leaf) and not _warps_masks(leaf)):
                raise TypeError(
                    f"geometry must be augmentations of kornia that warp a mask with the image, got a "
                    f"{type(leaf).__name__}"
                )
        for module in (part for augmentation in augmentations for part in augmentation.modules()):
            resample = getattr(module, "extra_args", {}).get(DataKey.MASK, {}).get("resample")
            if resample is not None and resample.name != "NEAREST":
                raise ValueError(f"depth must be resampled by the nearest pixel, got extra_args with {resample.name}")
        self.container = K.AugmentationSequential(*cast("Any", augmentations), data_keys=None)
        self.scale_depth = scale_depth

    @property
    def params(self) -> Any:
        """The last draws."""
        return self.container._params

    def forward(
        self,
        image: Tensor,
        depth: Tensor,
        valid: Tensor | None = None,
        others: Mapping[str, Any] | None = None,
        params: Any = None,
    ) -> Scene:
        """Warp a scene.

        Args:
            image: (B, C, H, W) or (C, H, W).
            depth: (B, 1, H, W) or (1, H, W); 0 and less, and NaN, are holes.
            valid: where the depth is valid, bool. Default: everywhere but in holes.
            others: masks, boxes and keypoints that are warped too, under the names that kornia knows them by.
            params: earlier draws, to be repeated.
        """
        check_float_tensor("image", image, 3 if image.ndim == 3 else 4, "(B, C, H, W) or (C, H, W)")
        check_float_tensor("depth", depth, image.ndim, "(B, 1, H, W) or (1, H, W), as the image is batched or not")
        check_values("a new tensor", torch.empty(0))  # kornia makes some
        size = (1, *image.shape[-2:])
        if tuple(depth.shape[-3:]) != size or (image.ndim == 4 and len(depth) not in (1, len(image))):
            raise ValueError(
                f"depth must be one map {size} for each image {tuple(image.shape)}, got {tuple(depth.shape)}"
            )
        if valid is not None and valid.numel() != depth.numel():
            raise ValueError(f"valid must have the depth's shape {tuple(depth.shape)}, got {tuple(valid.shape)}")
        wide = torch.promote_types(torch.promote_types(image.dtype, depth.dtype), torch.float32)
        known = (depth > 0) if valid is None else (valid.reshape(depth.shape) > 0) & (depth > 0)
        batched = image.ndim == 4
        parts = {"image": image.to(wide), _DEPTH: depth.to(wide), _VALID: known.to(wide)}
        if not batched:
            parts = {name: part[None] for name, part in parts.items()}
        count = len(parts["image"])
        parts = {name: part.expand(count, -1, -1, -1) for name, part in parts.items()}
        out = self.container({**parts, **(others or {})}, params=params)
        warped, seen = out.pop(_DEPTH), out.pop(_VALID) > 0.5
        seen &= warped > 0
        if self.scale_depth:
            warped = warped / self._magnification().to(warped)
        warped = fill_holes(warped.masked_fill(~seen, 0))[0].to(depth.dtype)
        whole = out.pop("image").to(image.dtype)
        scene = (whole, warped, seen) if batched else (whole[0], warped[0], seen[0])
        return Scene(*scene, out)

    def field_center(self, before: Tensor, after: Tensor, center: Any = (0.0, 0.0)) -> Tensor:
        """Return where the pictures of the last call lie, seen from the axis of the lens that is to take them.

        A crop lies off the axis as far as its middle lies from that of the picture it was cut from. A flip, a rotation
        or a change of size moves the place as it moves the picture about the axis; a perspective as in the middle.

        Args:
            before: the images that were given.
            after: the images that came out.
            center: middle of the given images, (2,) or (B, 2): y and x in pixels.

        Returns:
            (B, 2) float64 on the CPU, y and x in pixels of the images that came out; (2,) for unbatched ones.

        Raises:
            ValueError: if a warp that moves parts of an image differently has no matrix.

        Example:
            >>> import kornia.augmentation as K
            >>> geometry, image = SceneGeometry(K.CenterCrop(32)), torch.rand(2, 3, 64, 64)
            >>> out = geometry(image, torch.ones(2, 1, 64, 64)).image
            >>> geometry.field_center(image, out, (10.0, -20.0))
            tensor([[ 10., -20.],
                    [ 10., -20.]], dtype=torch.float64)
        """
        count = 1 if after.ndim == 3 else len(after)
        places = torch.tensor(check_centers(center, count), dtype=torch.float64).expand(count, 2)
        (rows, columns), (height, width) = before.shape[-2:], after.shape[-2:]
        axis = torch.tensor([(columns - 1) / 2, (rows - 1) / 2], dtype=torch.float64) - places.flip(1)
        middle = torch.tensor([(width - 1) / 2, (height - 1) / 2, 1], dtype=torch.float64)
        if (matrix := self.container.transform_matrix) is None:
            raise ValueError("the place of a picture in the field needs a warp with a matrix, got none")
        back = torch.linalg.inv(matrix.detach().cpu().double())
        there = back @ middle  # what the middle shows, times there[:, 2]
        # The axis may lie beyond the horizon of a perspective: its place follows from the warp at the middle.
        shown = there[:, :2] / there[:, 2:]
        slopes = (back[:, :2, :2] - shown[..., None] * back[:, 2:, :2]) / there[:, 2, None, None]
        found = torch.linalg.solve(slopes, shown - axis).flip(1)
        found = found.round(decimals=3)  # matrices are float32, and equal places have the same PSFs
        return found[0] if after.ndim == 3 else found

    def _magnification(self) -> Tensor:
        """Return how much each image was enlarged, (B, 1, 1, 1)."""
        matrix = self.container.transform_matrix
        affine = None if matrix is None else matrix[:, 2] - matrix.new_tensor([0.0, 0.0, 1.0])
        if matrix is None or affine is None or bool(affine.abs().amax() > 1e-6):
            raise ValueError(
                "scale_depth needs a warp that enlarges all parts of an image alike, got none that is affine"
            )
        return torch.linalg.det(matrix[:, :2, :2]).abs().sqrt()[:, None, None, None]


def _warps_masks(module: nn.Module) -> bool:
    return isinstance(module, (K.GeometricAugmentationBase2D, ImageSequentialBase))


def warped_entries(sample: Mapping[str, Any], taken: tuple[str, ...]) -> dict[str, Any]:
    """Return the further entries of a mapping that kornia warps with the image.

    Args:
        sample: image, depth and others by name.
        taken: names of image, depth and valid mask.

    Raises:
        ValueError: if an entry has the size of the image and a name that kornia does not know: it would pass
            unwarped.

    Example:
        >>> sample = {"image": torch.ones(3, 8, 8), "keypoints": torch.ones(1, 2, 2), "name": "a"}
        >>> sorted(warped_entries(sample, ("image",)))
        ['keypoints']
    """
    size, found = sample[taken[0]].shape[-2:], {}
    for name, value in sample.items():
        if name in taken:
            continue
        if name.upper().startswith(tuple(f"{key}{end}" for key in KNOWN for end in "_-")) or name.upper() in KNOWN:
            found[name] = value
        elif isinstance(value, Tensor) and value.ndim > 1 and value.shape[-2:] == size:
            raise ValueError(
                f"the entry {name!r} has the image's size and a name that kornia does not warp: call it "
                f"'mask_{name}', and it is warped by the nearest pixel"
            )
    return found
