"""torchvision v2: depth as a tensor type, and the camera as a transform of samples of any structure.

Needs torchvision 0.22 or newer; nothing else of the package imports it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import torch
from torch import Tensor

from kornia_tidy.arrays import depth_tensor, image_tensor, like_image
from kornia_tidy.augmentation.depth_augmentation import checked_optics
from kornia_tidy.camera.holes import fills_holes, with_filled
from kornia_tidy.checks import check_choice
from kornia_tidy.optics.holes import HOLES, fill_holes
from kornia_tidy.search_path import missing

try:
    from PIL import Image as PILImage
    from torchvision import tv_tensors  # ty: ignore[import-not-found]
    from torchvision.transforms import v2  # ty: ignore[import-not-found]
except (ImportError, RuntimeError) as error:  # RuntimeError: torchvision and torch are of different builds
    raise missing("torchvision", "kornia_tidy.augmentation.torchvision_v2", error) from error


class Depth(tv_tensors.Mask):
    """A depth map among the tensor types of torchvision: warped like a mask, and left alone by photometric transforms.

    Convention:
        - Resampled by the nearest pixel. Pixels from beyond the image are 0, a hole, for any ``fill``.
        - (1, H, W), or (T, 1, H, W) beside a video.

    Example:
        >>> from torchvision.transforms import v2
        >>> flip = v2.RandomHorizontalFlip(p=1.0)
        >>> flip(tv_tensors.Image(torch.rand(3, 4, 5)), Depth(torch.ones(1, 4, 5)))[1].__class__.__name__
        'Depth'
    """


class Valid(tv_tensors.Mask):
    """Where a depth map was known, bool: warped with the :class:`Depth`, and also False beyond the image."""


def _register_kernels() -> None:
    """Register kernels for depth where a mask would take the fill value of the image."""
    functional = v2.functional
    for name in ("pad", "rotate", "affine", "perspective", "elastic"):
        kernel = getattr(functional, f"{name}_mask")

        def of_depth(depth: Depth | Valid, *args: Any, _kernel: Any = kernel, **options: Any) -> Any:
            options = {key: value for key, value in options.items() if key not in ("fill", "interpolation")}
            return tv_tensors.wrap(_kernel(depth.as_subclass(Tensor), *args, **options), like=depth)

        for kind in (Depth, Valid):
            functional.register_kernel(getattr(functional, name), kind)(of_depth)


_register_kernels()


class OpticsTransform(v2.Transform):
    """Take the picture of a sample's image with its depth, as a transform of torchvision v2.

    Args:
        optics: :class:`~kornia_tidy.TiDyOptics`, or an augmentation that reads depth, such as
            :class:`~kornia_tidy.augmentation.RandomTiDyOptics`. Default: ``TiDyOptics()``.
        depth_scale: metres in one unit of the depth; 0.001 for millimetres. Whole numbers need it; others are metres.
        holes: ``"fill"`` fills holes of the depth, such as the zeros that a rotation leaves, from the nearest known
            pixel, as :func:`kornia_tidy.data.fill_holes` does; ``"error"`` leaves them to the optics.

    Shape:
        - Any structure with one :class:`Depth` and one or more images of its size: ``tv_tensors.Image``, a PIL image, a
          ``tv_tensors.Video`` with a depth of each frame, or else a plain tensor. Images come back
          in the type in which they came, 8-bit ones rounded; all else as it was.

    Raises:
        ValueError: if the sample has no Depth or several, or no image, or its Depth holds whole numbers without a
            scale; as the camera.

    Convention:
        - The structure of the sample is kept: without ``holes="fill"`` no entry is added, so that ``v2.RandomApply``
          keeps one set of keys.
        - With ``holes="fill"``, here or of the optics, the Depth comes out filled, and a mapping that holds it gets
          ``"valid"``, a :class:`Valid` that later transforms move with it: False in holes, and where a ``"valid"`` or a
          bool ``"mask"`` of the depth's shape that it had was False. A named tuple asks for it by a field ``valid``.

    Example:
        >>> from torchvision.transforms import v2
        >>> chain = v2.Compose([v2.RandomHorizontalFlip(), OpticsTransform(), v2.ColorJitter(0.2)])
        >>> sample = chain({"image": tv_tensors.Image(torch.rand(3, 64, 64)), "depth": Depth(torch.ones(1, 64, 64))})
        >>> type(sample["image"]).__name__, type(sample["depth"]).__name__
        ('Image', 'Depth')
    """

    _transformed_types = (Tensor, PILImage.Image)

    def __init__(
        self, optics: torch.nn.Module | None = None, depth_scale: float | None = None, holes: str = "error"
    ) -> None:
        check_choice("holes", holes, HOLES)
        super().__init__()
        self.depth_scale, self.holes = depth_scale, holes
        self.optics = checked_optics(optics)

    def forward(self, *inputs: Any) -> Any:
        """Return the sample with its images coded, and with its depth filled first if holes are to be filled."""
        if fills_holes(self.optics, self.holes):
            inputs = tuple(map(_without_holes, inputs))
        return super().forward(*inputs)

    def make_params(self, flat_inputs: list[Any]) -> dict[str, Any]:
        """Return the depth of a sample in metres."""
        depths = [entry for entry in flat_inputs if isinstance(entry, Depth)]
        if len(depths) != 1:
            raise ValueError(
                f"a sample must hold one Depth for its images, got {len(depths)}: wrap the map as Depth(depth), so "
                f"that other transforms warp it too"
            )
        if not any(_is_image(entry) for entry in flat_inputs):
            raise ValueError("a sample must hold an image beside its Depth: an Image, a PIL image or a tensor")
        return {"depth": depth_tensor(depths[0], self.depth_scale)}

    def transform(self, entry: Any, params: dict[str, Any]) -> Any:
        """Return the capture of an image, and everything else unchanged."""
        if not _is_image(entry):
            return entry
        plain = entry.as_subclass(Tensor) if isinstance(entry, Tensor) else entry
        image = image_tensor(plain)
        coded = self.optics(image, params["depth"].to(image.device)).reshape(image.shape)
        out = like_image(coded, plain)
        return tv_tensors.wrap(out, like=entry) if isinstance(entry, tv_tensors.TVTensor) else out


def _is_image(entry: Any) -> bool:
    plain = isinstance(entry, Tensor) and not isinstance(entry, tv_tensors.TVTensor)
    return plain or isinstance(entry, (tv_tensors.Image, tv_tensors.Video, PILImage.Image))


def _without_holes(entry: Any) -> Any:
    """Return a sample, or a part of it, with its depth filled and the mask of known pixels where it has a place."""
    if isinstance(entry, Depth):
        return Depth(fill_holes(entry.as_subclass(Tensor))[0])
    if isinstance(entry, Mapping):
        names = [name for name, value in entry.items() if isinstance(value, Depth)]
        sample = {name: value if name in names else _without_holes(value) for name, value in entry.items()}
        return _with_valid(sample, names) if len(names) == 1 else sample
    if not isinstance(entry, (tuple, list)):
        return entry
    if "valid" in getattr(entry, "_fields", ()) and isinstance(entry[1], Depth):
        return _with_valid(entry, [])
    parts, make = [_without_holes(value) for value in entry], cast("Any", type(entry))
    return make(*parts) if hasattr(entry, "_fields") else make(parts)


def _with_valid(sample: Any, names: list[Any]) -> Any:
    """Return a mapping that holds its depth under the first name, or a named tuple, filled and with its valid mask."""
    named = isinstance(sample, Mapping)
    depth, valid = fill_holes((sample[names[0]] if named else sample[1]).as_subclass(Tensor))
    filled = with_filled(sample, Depth(depth), valid, names)
    mask = Valid(filled["valid"] if named else filled.valid)
    return {**filled, "valid": mask} if named else filled._replace(valid=mask)
