"""albumentations 2: the camera as a transform of arrays that takes depth as a target.

Needs albumentations 2; nothing else of the package imports it. Its wheel brings a second OpenCV, which overwrites that
of this package: ``pip install --force-reinstall --no-deps opencv-contrib-python-headless`` puts it back.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import torch

from kornia_tidy.arrays import depth_tensor, image_tensor, like_image
from kornia_tidy.augmentation.depth_augmentation import checked_optics
from kornia_tidy.camera.holes import both_valid, fills_holes
from kornia_tidy.checks import check_choice, unmasked
from kornia_tidy.optics.holes import HOLES, fill_holes
from kornia_tidy.search_path import missing

try:
    import albumentations as A  # ty: ignore[import-not-found]
    from albumentations.core.transforms_interface import (  # ty: ignore[import-not-found]
        BaseTransformInitSchema,
    )
except ImportError as error:
    raise missing("albumentations", "kornia_tidy.augmentation.albumentations_v2", error) from error


class OpticsTransform(A.DualTransform):
    """Take the picture of an image with its depth, as a transform of albumentations.

    Args:
        optics: :class:`~kornia_tidy.TiDyOptics`, or an augmentation that reads depth, such as
            :class:`~kornia_tidy.augmentation.RandomTiDyOptics`. Default: ``TiDyOptics()``.
        p: probability of the picture to be taken.
        depth_scale: metres in one unit of the depth; 0.001 for millimetres. Whole numbers need it; others are metres.
        holes: ``"fill"`` fills holes of the depth, such as the zeros that a rotation leaves, from the nearest known
            pixel, as :func:`kornia_tidy.data.fill_holes` does; ``"error"`` leaves them to the optics.

    Shape:
        - ``image``: (H, W, 3), (H, W, 1) or (H, W), 8-bit, 16-bit or float in [0, 1]; comes back in its type.
        - ``depth``: (H, W) or (H, W, 1); comes back as it was, or filled in its type. Masks, boxes and keypoints come
          back as they were.
        - ``valid``, only where holes are filled: uint8 in the depth's shape, 0 in holes, and where a ``valid`` that was
          given is 0. It comes back whether or not the picture is taken.

    Raises:
        ValueError: if the depth is missing, the ``Compose`` does not warp depth as a mask or interpolates masks, or the
            camera's border is ``"valid"``; if image or depth have masked values, or a depth of whole numbers has no
            scale; as the camera.

    Convention:
        - Give ``additional_targets={"depth": "mask"}`` to ``Compose``: else its flips would flip the image and not the
          depth. That is refused. Where holes are filled, also give it ``"valid": "mask"``.
        - ``Compose`` drops the mask of a masked array: give it ``depth.filled(0)``, since zeros are holes.
        - Noise and draws follow from the seed of ``Compose``. The generator of torch does not change.

    Example:
        >>> chain = A.Compose([A.HorizontalFlip(), OpticsTransform()], additional_targets={"depth": "mask"}, seed=3)
        >>> sample = chain(image=np.zeros((64, 64, 3), np.uint8), depth=np.ones((64, 64), np.float32))
        >>> sample["image"].shape, sample["image"].dtype
        ((64, 64, 3), dtype('uint8'))
    """

    _targets = ()

    class InitSchema(BaseTransformInitSchema):
        """Arguments, as albumentations checks them."""

        optics: Any
        depth_scale: Any
        holes: Any

    def __init__(
        self,
        optics: torch.nn.Module | None = None,
        p: float = 1.0,
        depth_scale: float | None = None,
        holes: str = "error",
    ) -> None:
        check_choice("holes", holes, HOLES)
        super().__init__(p=p)
        self.depth_scale, self.holes = depth_scale, holes
        self.optics = checked_optics(optics)
        self.mask_interpolation = cv2.INTER_NEAREST  # Compose(mask_interpolation=) sets it, as that of every transform

    def __call__(self, *args: Any, force_apply: bool = False, **kwargs: Any) -> Any:
        """Apply the transform; depth that others would not warp is refused whether or not the picture is taken."""
        fills = "depth" in kwargs and fills_holes(self.optics, self.holes)
        for name in ("depth", *(["valid"] if fills else [])):
            if (name in kwargs or fills) and self._additional_targets.get(name) != "mask":
                targets = "'depth': 'mask', 'valid': 'mask'" if fills else "'depth': 'mask'"
                raise ValueError(
                    f"{name} passes through other transforms unwarped: tell them of it with "
                    f"A.Compose([...], additional_targets={{{targets}}})"
                )
        for name in ("image", "depth"):  # albumentations would drop the mask of a masked array
            unmasked(name, kwargs.get(name))
        if fills:
            kwargs["depth"], valid = fill_holes(kwargs["depth"])
            valid = both_valid(valid, kwargs["valid"]) if "valid" in kwargs else valid
            kwargs["valid"] = valid.astype(np.uint8)  # OpenCV warps no bool
        return super().__call__(*args, force_apply=force_apply, **kwargs)

    @property
    def targets_as_params(self) -> list[str]:
        """Return the targets that a capture needs."""
        return ["image", "depth"]

    def get_params(self) -> dict[str, Any]:
        """Return the seed of the capture."""
        return {"seed": int(self.random_generator.integers(2**31))}

    def get_params_dependent_on_data(self, params: dict[str, Any], data: dict[str, Any]) -> dict[str, Any]:
        """Return the depth of a sample in metres."""
        if self.mask_interpolation != cv2.INTER_NEAREST:
            raise ValueError(
                "depth must be resampled by the nearest pixel, got a Compose with another mask_interpolation"
            )
        return {"depth_of_capture": depth_tensor(data["depth"], self.depth_scale)}

    def apply(self, img: np.ndarray, depth_of_capture: torch.Tensor, seed: int, **params: Any) -> np.ndarray:
        """Return the capture of an image."""
        image = image_tensor(img)
        with torch.no_grad(), torch.random.fork_rng():
            torch.manual_seed(seed)
            coded = self.optics(image, depth_of_capture).reshape(image.shape)
        return like_image(coded, img)

    @property
    def targets(self) -> dict[str, Callable[..., Any]]:
        """Return the function for each target: images are coded, masks, boxes and keypoints returned unchanged."""
        return {
            "image": self.apply,
            **dict.fromkeys(("mask", "masks", "bboxes", "keypoints"), _unchanged),
        }


def _unchanged(target: Any, **params: Any) -> Any:
    return target
