"""Scenes of the app in files: image and depth, made smaller."""

from __future__ import annotations

import os
from pathlib import Path

from kornia_tidy.data.depth_files import read_depth
from kornia_tidy.data.image_files import read_image
from kornia_tidy.data.rgbd import Scene

PLAUSIBLE = (5e-3, 200.0)  # m; a middle depth outside is probably in another unit


def read_files(
    image_file: str | os.PathLike[str], depth_file: str | os.PathLike[str], depth_scale: float, side: int
) -> Scene:
    """Read image and depth, and make them smaller if their longer side has more pixels.

    Args:
        image_file: see :func:`~kornia_tidy.data.read_image`.
        depth_file: see :func:`~kornia_tidy.data.read_depth`.
        depth_scale: metres per stored unit.
        side: longest side in pixels.

    Returns:
        Image with three channels, averaged to the new size; depth and validity of the nearest pixel.

    Raises:
        FileNotFoundError: if a file is missing.
        ValueError: if a file cannot be read, the two differ in size, or the depths are not plausible metres.

    Example:
        >>> import tempfile
        >>> import torch
        >>> from kornia_tidy.data import write_depth, write_image
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_image(f"{folder}/image.png", torch.rand(3, 40, 60))
        ...     write_depth(f"{folder}/depth.png", torch.full((1, 40, 60), 1.25), scale=0.001)
        ...     scene = read_files(f"{folder}/image.png", f"{folder}/depth.png", 0.001, side=30)
        >>> scene.image.shape, scene.depth.unique()
        (torch.Size([3, 20, 30]), tensor([1.2500]))
    """
    image, (depth, valid) = read_image(image_file), read_depth(depth_file, depth_scale)
    if image.shape[1:] != depth.shape[1:]:
        sizes = [f"{picture.shape[2]} x {picture.shape[1]}" for picture in (image, depth)]
        raise ValueError(
            f"photo and depth map must have the same size, got {sizes[0]} and {sizes[1]} pixels: give the depth map of "
            f"this photo"
        )
    middle = float(depth[valid].median())
    if not PLAUSIBLE[0] <= middle <= PLAUSIBLE[1]:
        raise ValueError(
            f"the middle depth of {Path(depth_file).name} would be {middle:.3g} m, where {PLAUSIBLE[0]:g} to "
            f"{PLAUSIBLE[1]:g} m are plausible: choose another unit of the depth map"
        )
    return Scene(image, depth, valid).within(side)
