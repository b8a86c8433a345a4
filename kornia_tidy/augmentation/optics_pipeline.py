"""OpticsPipeline: geometric augmentations, then the camera, then photometric ones, for tuples and mappings."""

from __future__ import annotations

from collections.abc import Mapping
from functools import reduce
from typing import Any, cast

import kornia.augmentation as K
from torch import Tensor, nn

from kornia_tidy.augmentation.depth_augmentation import (
    DepthAugmentation,
    camera_of,
    checked_optics,
    container_leaves,
    moves_pixels,
)
from kornia_tidy.augmentation.pipeline_transform import PipelineTransform, draws_at
from kornia_tidy.augmentation.scene_geometry import SceneGeometry, warped_entries
from kornia_tidy.camera.holes import both_valid, fills_holes, names_in, with_parts
from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.checks import check_choice
from kornia_tidy.optics.holes import HOLES, fill_holes


class OpticsPipeline(nn.Module):
    """Augment scenes in the order of light: warp image and depth together, take the picture, change its colours.

    Args:
        geometry: an augmentation of kornia, an ``AugmentationSequential``, or a
            :class:`~kornia_tidy.augmentation.SceneGeometry`. None: no warp.
        optics: :class:`~kornia_tidy.TiDyOptics`, or an augmentation that reads depth, such as
            :class:`~kornia_tidy.augmentation.RandomTiDyOptics`. Default: ``TiDyOptics()``.
        photometry: augmentations that move no pixel, for the image only. None: none.
        holes: ``"fill"`` fills holes of the depth from the nearest known pixel, as :func:`kornia_tidy.data.fill_holes`
            does; ``"error"`` leaves them to the optics. Geometry fills its own holes.

    Shape:
        - ``pipeline(image, depth)``: (B, C, H, W) and (B, 1, H, W), or both without B, to image and depth.
        - ``pipeline((image, depth, ...))`` to the same tuple.
        - ``pipeline({"image": ..., "depth": ..., ...})`` to the same mapping, with ``"all_in_focus"`` the warped image
          without optics, and, where geometry left holes in the depth, ``"mask"`` False there. The depth may stand
          under ``"mask_depth"``. With ``holes="fill"``, here or of the optics, ``"valid"`` is always there: bool in the
          depth's shape, False in holes, and where a ``"valid"`` or a bool ``"mask"`` that was given is False. A named
          tuple asks for it by a field ``valid``.

    Raises:
        TypeError: if a part is of another kind.
        ValueError: if photometry may move pixels, the camera's border is ``"valid"``, or an entry of the image's size
            would pass unwarped; on use, as the parts.
        KeyError: if a mapping has no image or no depth.

    Convention:
        - The returned depth is warped by the geometry, with holes filled. It keeps its type, which should be
          float32, whatever the image's is.
        - A mapping's masks, boxes and keypoints are warped too, by the names that kornia knows; ``"valid"``, and
          ``"mask"`` if it is bool, tell where the depth is valid.
        - :attr:`params` holds the draws of the last call; ``params=`` repeats them.
        - Behind a lens the geometry says where crops lie in its field, counted from the entry ``"field_center"`` of a
          mapping if it has one; a mapping comes back with the place of the capture under this name.

    Example:
        >>> import kornia.augmentation as K
        >>> import torch
        >>> pipeline = OpticsPipeline(K.RandomHorizontalFlip(), photometry=K.ColorJiggle(0.1, 0.1))
        >>> sample = pipeline({"image": torch.rand(2, 3, 64, 64), "depth": torch.ones(2, 1, 64, 64), "name": "a"})
        >>> sorted(sample)
        ['all_in_focus', 'depth', 'image', 'name']
    """

    def __init__(
        self,
        geometry: nn.Module | None = None,
        optics: nn.Module | None = None,
        photometry: nn.Module | None = None,
        holes: str = "error",
    ) -> None:
        check_choice("holes", holes, HOLES)
        super().__init__()
        self.holes = holes
        for leaf in container_leaves(photometry) if photometry is not None else ():
            if moves_pixels(leaf) or isinstance(leaf, DepthAugmentation):
                raise ValueError(
                    f"photometry may not move pixels, got a {type(leaf).__name__}: the depth would not move with them; "
                    f"put it into geometry"
                )
        whole = geometry is None or isinstance(geometry, SceneGeometry)
        self.geometry = geometry if whole else SceneGeometry(cast("nn.Module", geometry))
        self.optics = checked_optics(optics)
        self.photometry = None if photometry is None else K.ImageSequential(photometry)
        self.params: dict[str, Any] = {}

    def forward(self, image: Any, depth: Tensor | None = None, params: Mapping[str, Any] | None = None) -> Any:
        """Augment a scene given as tensors, a tuple or a mapping.

        Args:
            image: the image, or a whole sample; see the class for the forms.
            depth: the depth map, if ``image`` is a tensor.
            params: :attr:`params` of an earlier call, to be repeated.
        """
        if isinstance(image, Mapping):
            return self._mapping(image, params)
        if isinstance(image, (tuple, list)):
            if len(image) < 2 or depth is not None:
                raise ValueError(f"a tuple sample must be (image, depth, ...), got {len(image)} entries")
            given = image[0], image[1], getattr(image, "valid", None), {}, params
            coded, warped, _, valid, _ = self._scene(*given, getattr(image, "field_center", None))
            return with_parts(image, coded, warped, valid)
        if depth is None:
            raise ValueError(
                "depth is missing: call pipeline(image, depth), pipeline((image, depth)) or pipeline(mapping)"
            )
        return self._scene(image, depth, None, {}, params)[:2]

    def as_transform(self, seed: int | None = None, key: Any = "index") -> PipelineTransform:
        """Return the pipeline as a transform of single samples, without gradients. See :class:`PipelineTransform`."""
        return PipelineTransform(self, seed, key)

    def _mapping(self, sample: Mapping[str, Any], params: Mapping[str, Any] | None) -> dict[str, Any]:
        names = names_in(sample)
        mask = sample.get("mask")
        shown = {} if mask is None or str(mask.dtype) != "torch.bool" else {"mask": mask}
        shown |= {"valid": sample["valid"]} if isinstance(sample.get("valid"), Tensor) else {}
        taken = (*names, *shown)
        others = {} if self.geometry is None else warped_entries(sample, taken)
        known = reduce(both_valid, shown.values()) if shown else None
        place = sample.get("field_center")
        image, depth = (sample[name] for name in names)
        coded, depth, clean, valid, warped = self._scene(image, depth, known, others, params, place)
        out = {**sample, **warped, "image": coded, "all_in_focus": clean, names[1]: depth}
        if "field_center" in self.params:
            out["field_center"] = self.params["field_center"]
        masks = [*shown, *(["valid"] if fills_holes(self.optics, self.holes) else [])]
        if valid is not None and not masks and not bool(valid.all()):
            masks = ["mask" if mask is None else "mask_of_valid_depth"]
        return out if valid is None else {**out, **dict.fromkeys(masks, valid)}

    def _scene(
        self,
        image: Tensor,
        depth: Tensor,
        valid: Tensor | None,
        others: Mapping[str, Any],
        params: Mapping[str, Any] | None,
        place: Any = None,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor | None, Mapping[str, Any]]:
        """Return capture, depth, clean image, where the depth is valid, and the other entries."""
        given, drawn, fills, before = params or {}, {}, fills_holes(self.optics, self.holes), image
        if self.geometry is not None:
            image, depth, valid, others = self.geometry(image, depth, valid, others, params=given.get("geometry"))
            drawn["geometry"] = self.geometry.params
        elif fills:
            depth, known = fill_holes(depth)
            valid = known if valid is None else both_valid(known, valid)
        if (place := given.get("field_center", self._place(before, image, place))) is not None:
            drawn["field_center"] = place
        if isinstance(self.optics, TiDyOptics):
            drawn["optics"] = given["optics"] if "optics" in given else self.optics.draw(image)
            coded = self.optics(image, depth, params=drawn["optics"], field_center=place)
        else:
            coded = self.optics(image, depth, params=self._draws(image, given.get("optics"), place))
            drawn["optics"] = self.optics._params
            coded = coded.reshape(image.shape)
        if self.photometry is not None:
            coded = self.photometry(coded, params=given.get("photometry")).reshape(image.shape)
            drawn["photometry"] = self.photometry._params
        self.params = drawn
        return coded, depth, image, valid, others

    def _place(self, before: Tensor, after: Tensor, place: Any) -> Any:
        """Return where the warped pictures lie in the camera's field; None where nothing says it."""
        camera = camera_of(self.optics)
        if camera is None or not camera.psf_model.varies or self.geometry is None:
            return place
        return self.geometry.field_center(before, after, camera.field_center if place is None else place)

    def _draws(self, image: Tensor, params: dict[str, Any] | None, place: Any) -> dict[str, Any] | None:
        """Return the draws of an augmentation, with the place of each image where that is known."""
        optics, camera = self.optics, camera_of(self.optics)
        if place is None or params is not None or camera is None or not camera.psf_model.varies:
            return params
        assert isinstance(optics, DepthAugmentation)
        return draws_at(optics, image, place)
