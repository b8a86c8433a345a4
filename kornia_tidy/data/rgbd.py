"""RGB-D files: reading a picture together with its depth map."""

from __future__ import annotations

import os
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
import torch
from kornia.geometry.transform import resize
from torch import Tensor

from kornia_tidy.checks import check_choice
from kornia_tidy.data.depth_files import DepthMap, read_depth
from kornia_tidy.data.guided_fill import fill_guided
from kornia_tidy.data.image_files import read_image
from kornia_tidy.data.orientation import told
from kornia_tidy.data.stored import read_stored

SAME_RATIO = 0.02  # relative difference of the ratios of sides: ScanNet's 1296 x 968 and 640 x 480 differ by 0.004


class Scene(NamedTuple):
    """A picture with depth."""

    image: Tensor
    """(3, H, W) or (1, H, W) float32 in [0, 1], encoded as stored."""
    depth: Tensor
    """(1, H, W) float32 in metres, positive everywhere."""
    valid: Tensor
    """(1, H, W) bool, False where depth was unknown and is filled in."""

    @classmethod
    def whole(cls, image: Tensor, depth: Tensor) -> Scene:
        """Return a scene whose depth is known everywhere."""
        return cls(image, depth, torch.ones_like(depth, dtype=torch.bool))

    def within(self, side: int) -> Scene:
        """Return the scene in colour, made smaller if its longer side has more pixels.

        Args:
            side: longest side in pixels.

        Returns:
            Image with three channels, averaged to the new size; depth and validity of the nearest pixel.

        Example:
            >>> grey = Scene(torch.rand(1, 40, 60), torch.ones(1, 40, 60), torch.ones(1, 40, 60, dtype=torch.bool))
            >>> grey.within(30).image.shape
            torch.Size([3, 20, 30])
        """
        image, depth, valid = self
        if max(image.shape[1:]) > side:
            image = resize(image[None], side, side="long", antialias=True)[0].clamp(0, 1)
            depth, valid = (
                resize(plane[None].float(), side, side="long", interpolation="nearest")[0] for plane in (depth, valid)
            )
        return Scene(image.expand(3, -1, -1), depth, valid > 0)


def read_rgbd(
    image_path: str | os.PathLike[str],
    depth_path: str | os.PathLike[str],
    *,
    resample: Literal["image", "depth"] | None = None,
    fill: Literal["nearest", "guided"] = "nearest",
    **depth_options: Any,
) -> Scene:
    """Read a picture and its depth.

    Args:
        image_path: see :func:`~kornia_tidy.data.image_files.read_image`.
        depth_path: see :func:`~kornia_tidy.data.depth_files.read_depth`.
        resample: of image and depth in different sizes, which of them is brought to the size of the other: ``"image"``
            by averaging over areas (linear interpolation where it is enlarged), ``"depth"`` by the nearest pixel. None:
            different sizes raise ``ValueError``.
        fill: of unknown depth: ``"nearest"`` known pixel, or ``"guided"`` by the edges of the image, for sparse depth;
            see :func:`~kornia_tidy.data.guided_fill.fill_guided`.
        **depth_options: passed on to :func:`~kornia_tidy.data.depth_files.read_depth`.

    Returns:
        Image, depth and validity, of the same height and width.

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: if a file cannot be read, or the two differ in size and are not to be resampled, or differ in the
            ratio of their sides by more than 2 %.

    Example:
        >>> import tempfile, torch
        >>> from kornia_tidy.data.depth_files import write_depth
        >>> from kornia_tidy.data.image_files import write_image
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_image(f"{folder}/image.png", torch.rand(3, 4, 6))
        ...     write_depth(f"{folder}/depth.png", torch.full((1, 4, 6), 1.25), scale=0.001)
        ...     scene = read_rgbd(f"{folder}/image.png", f"{folder}/depth.png", scale=0.001)
        >>> scene.image.shape, scene.depth.unique(), bool(scene.valid.all())
        (torch.Size([3, 4, 6]), tensor([1.2500]), True)
    """
    check_pairing_options(resample, fill)
    image = read_image(image_path)
    depth, valid = read_depth(depth_path, **depth_options)
    if image.shape[1:] != depth.shape[1:]:
        sizes = [f"{t.shape[1]} x {t.shape[2]}" for t in (image, depth)]
        message = f"{image_path} has {sizes[0]}, {depth_path} has {sizes[1]}"
        if image.shape[1:] == depth.shape[:0:-1] and (turn := read_stored(image_path).orientation) > 1:
            message += f"; {told(image_path, turn)}"
        if resample is None:
            raise ValueError(
                f"image and depth must have the same size (rows x columns): {message} (resample='image' or 'depth' "
                f"brings one to the size of the other)"
            )
        ratios = [t.shape[1] / t.shape[2] for t in (image, depth)]
        if not 1 - SAME_RATIO < ratios[0] / ratios[1] < 1 + SAME_RATIO:
            raise ValueError(f"image and depth must show the same view, and their sides have other ratios: {message}")
        if resample == "image":
            image = _resized_image(image, depth.shape[1], depth.shape[2])
        else:
            depth, valid = _nearest(depth, valid, image.shape[1], image.shape[2])
    if fill == "guided":
        depth = torch.from_numpy(fill_guided(depth[0].numpy(), valid[0].numpy(), image))[None]
    return Scene(image, depth, valid)


def check_pairing_options(resample: str | None = None, fill: str = "nearest") -> None:
    """Raise ``ValueError`` if an option of :func:`read_rgbd` is not one of those allowed."""
    check_choice("resample", resample, (None, "image", "depth"))
    check_choice("fill", fill, ("nearest", "guided"))


def _resized_image(image: Tensor, height: int, width: int) -> Tensor:
    """Return an image averaged over areas to a smaller size, or interpolated to a larger one."""
    smaller = height <= image.shape[1] and width <= image.shape[2]
    planes = image.permute(1, 2, 0).numpy()
    resized = cv2.resize(planes, (width, height), interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR)
    return torch.from_numpy(np.ascontiguousarray(np.atleast_3d(resized).transpose(2, 0, 1))).clamp(0, 1)


def _nearest(depth: Tensor, valid: Tensor, height: int, width: int) -> DepthMap:
    """Return depth and validity at another size, each pixel from the nearest one."""
    rows, columns = (
        torch.from_numpy(((np.arange(new) + 0.5) * old / new).astype(np.int64))
        for new, old in ((height, depth.shape[1]), (width, depth.shape[2]))
    )
    return DepthMap(depth[:, rows][..., columns], valid[:, rows][..., columns])
