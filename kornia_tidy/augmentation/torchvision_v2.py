"""torchvision v2: depth as a tensor type of its own, and the camera as a transform of samples of any structure.

Needs torchvision 0.22 or newer; nothing else of the package imports it.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from kornia_tidy.augmentation.depth_augmentation import DepthAugmentation
from kornia_tidy.augmentation.holes import fill_holes
from kornia_tidy.camera.image_types import image_tensor, like_image
from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.checks import check_part

try:
    from PIL import Image as PILImage
    from torchvision import tv_tensors  # ty: ignore[import-not-found]
    from torchvision.transforms import v2  # ty: ignore[import-not-found]
except (ImportError, RuntimeError) as error:  # RuntimeError: torchvision and torch are of different builds
    raise ImportError(f"kornia_tidy.augmentation.torchvision_v2 needs torchvision: {error}") from error


class Depth(tv_tensors.Mask):
    """A depth map among the tensor types of torchvision: warped like a mask, and left alone by photometric transforms.

    Convention:
        - Resampled by the nearest pixel. What comes from beyond the image is 0, a hole, whatever ``fill`` says.
        - (1, H, W), or (T, 1, H, W) beside a video.

    Example:
        >>> from torchvision.transforms import v2
        >>> flip = v2.RandomHorizontalFlip(p=1.0)
        >>> flip(tv_tensors.Image(torch.rand(3, 4, 5)), Depth(torch.ones(1, 4, 5)))[1].__class__.__name__
        'Depth'
    """


def _register_kernels() -> None:
    """Register kernels for depth where a mask would take the fill value of the image."""
    functional = v2.functional
    for name in ("pad", "rotate", "affine", "perspective", "elastic"):
        kernel = getattr(functional, f"{name}_mask")

        def of_depth(depth: Depth, *args: Any, _kernel: Any = kernel, **options: Any) -> Any:
            options = {key: value for key, value in options.items() if key not in ("fill", "interpolation")}
            return tv_tensors.wrap(_kernel(depth.as_subclass(Tensor), *args, **options), like=depth)

        functional.register_kernel(getattr(functional, name), Depth)(of_depth)


_register_kernels()


class OpticsTransform(v2.Transform):
    """Take the picture of a sample's image with its depth, as a transform of torchvision v2.

    Args:
        optics: :class:`~kornia_tidy.TiDyOptics`, or an augmentation that reads depth, such as
            :class:`~kornia_tidy.augmentation.RandomTiDyOptics`. Default: ``TiDyOptics()``.

    Shape:
        - Any structure with one :class:`Depth` and one or more images of its size: ``tv_tensors.Image``, a PIL image, a
          ``tv_tensors.Video`` with a depth of each frame, or a plain tensor if there is none of these. Images come back
          in the type in which they came, 8-bit ones rounded; all else as it was.

    Raises:
        ValueError: if the sample has no Depth or several, or no image; as the camera.

    Convention:
        - The structure of the sample is kept: no entry is added, so that ``v2.RandomApply`` keeps one set of keys.
        - Holes of the depth, which are 0, are filled for the capture. The depth that comes out still has them.

    Example:
        >>> from torchvision.transforms import v2
        >>> chain = v2.Compose([v2.RandomHorizontalFlip(), OpticsTransform(), v2.ColorJitter(0.2)])
        >>> sample = chain({"image": tv_tensors.Image(torch.rand(3, 64, 64)), "depth": Depth(torch.ones(1, 64, 64))})
        >>> type(sample["image"]).__name__, type(sample["depth"]).__name__
        ('Image', 'Depth')
    """

    _transformed_types = (Tensor, PILImage.Image)

    def __init__(self, optics: torch.nn.Module | None = None) -> None:
        super().__init__()
        self.optics = TiDyOptics() if optics is None else optics
        expected = "TiDyOptics or an augmentation that reads depth"
        check_part("optics", self.optics, (TiDyOptics, DepthAugmentation), expected)
        camera = self.optics if isinstance(self.optics, TiDyOptics) else getattr(self.optics, "optics", None)
        if getattr(camera, "border", None) == "valid":
            raise ValueError("border 'valid' crops the image and not the other entries of a sample: use another border")

    def make_params(self, flat_inputs: list[Any]) -> dict[str, Any]:
        """Return the depth of a sample, without holes."""
        depths = [entry for entry in flat_inputs if isinstance(entry, Depth)]
        if len(depths) != 1:
            raise ValueError(
                f"a sample must hold one Depth for its images, got {len(depths)}: wrap the map as Depth(depth), so "
                f"that other transforms warp it too"
            )
        if not any(_is_image(entry) for entry in flat_inputs):
            raise ValueError("a sample must hold an image beside its Depth: an Image, a PIL image or a tensor")
        depth = depths[0].as_subclass(Tensor)
        return {"depth": fill_holes(depth, depth > 0)}

    def transform(self, entry: Any, params: dict[str, Any]) -> Any:
        """Return the capture of an image, and all else as it is."""
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
