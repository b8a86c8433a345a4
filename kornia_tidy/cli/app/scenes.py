"""Scenes of the app: painted ones, a test chart at several depths, and image and depth files made smaller."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from kornia_tidy.data.depth_files import read_depth
from kornia_tidy.data.image_files import read_image
from kornia_tidy.data.rgbd import Scene

STEPS = 5  # depths of the chart
SPOKES = 18  # dark sectors of a star
PLAUSIBLE = (5e-3, 200.0)  # m; a middle depth outside is probably in another unit


def chart(height: int, width: int, depth_range: tuple[float, float] = (0.3, 10.0)) -> tuple[Tensor, Tensor]:
    """Draw a test chart: a star of radial spokes above bars of falling width, at each of five depths.

    Args:
        height: rows in pixels.
        width: columns in pixels.
        depth_range: nearest and farthest depth in metres; the farthest may be ``inf``. The five depths are evenly
            spaced in inverse depth, the nearest at the left.

    Returns:
        The image (3, H, W) in [0, 1], encoded as sRGB, and the depth (1, H, W) in metres.

    Source: ISO 12233, for the star (Siemens star).

    Example:
        >>> image, depth = chart(60, 80, (0.5, 2.0))
        >>> image.shape, depth[0, 0, ::16]
        (torch.Size([3, 60, 80]), tensor([0.5000, 0.6154, 0.8000, 1.1429, 2.0000]))
    """
    near, far = (1 / end for end in depth_range)
    y, x = np.mgrid[:height, :width]
    step = x * STEPS // width
    across = (x * STEPS % width + 0.5 * STEPS) / width - 0.5  # -0.5 to 0.5 in each strip, alike to the last bit
    down = (y + 0.5) / height
    strip = width / STEPS
    radius = np.hypot(across * strip, y + 0.5 - 0.3 * height)
    star = np.cos(SPOKES * np.arctan2(y + 0.5 - 0.3 * height, across * strip))
    period = np.select([down < 0.72, down < 0.81, down < 0.9], [0.4 * strip, 0.2 * strip, 0.1 * strip], 0.05 * strip)
    bars = np.cos(2 * np.pi * across * strip / period)
    ink = np.where(down < 0.6, np.where(radius < 0.42 * min(strip, 0.55 * height), star, -1.0), bars)
    ink = np.where((np.abs(across) > 0.44) | (down > 0.97), -1.0, ink) > 0
    paper = np.array([[0.93, 0.9, 0.82], [0.8, 0.9, 0.93], [0.93, 0.84, 0.84], [0.84, 0.92, 0.84], [0.9, 0.88, 0.93]])
    color = np.where(ink[..., None], 0.12, paper[step])
    dioptres = torch.from_numpy(near + (far - near) * step / (STEPS - 1))
    image = torch.from_numpy(np.ascontiguousarray(color.transpose(2, 0, 1))).float()
    return image, dioptres.reciprocal().float()[None]


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
