"""RGB-D files: reading a picture together with its depth map."""

from __future__ import annotations

import os
from typing import Any, NamedTuple

from torch import Tensor

from kornia_tidy.data.depth_files import read_depth
from kornia_tidy.data.image_files import read_image


class Scene(NamedTuple):
    """A picture with depth."""

    image: Tensor
    """(3, H, W) or (1, H, W) float32 in [0, 1], encoded as stored."""
    depth: Tensor
    """(1, H, W) float32 in metres, positive everywhere."""
    valid: Tensor
    """(1, H, W) bool, False where depth was unknown and is filled in."""


def read_rgbd(image_path: str | os.PathLike[str], depth_path: str | os.PathLike[str], **depth_options: Any) -> Scene:
    """Read a picture and its depth.

    Args:
        image_path: see :func:`~kornia_tidy.data.image_files.read_image`.
        depth_path: see :func:`~kornia_tidy.data.depth_files.read_depth`.
        **depth_options: passed on to :func:`~kornia_tidy.data.depth_files.read_depth`.

    Returns:
        Image, depth and validity, of the same height and width.

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: if a file cannot be read, or the two differ in size.

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
    image = read_image(image_path)
    depth, valid = read_depth(depth_path, **depth_options)
    if image.shape[1:] != depth.shape[1:]:
        sizes = [f"{t.shape[1]} x {t.shape[2]}" for t in (image, depth)]
        raise ValueError(
            f"image and depth must have the same size (rows x columns): {image_path} has {sizes[0]}, "
            f"{depth_path} has {sizes[1]}"
        )
    return Scene(image, depth, valid)
