"""Collages of photographs: dead leaves that are cut out of pictures, with exact depth."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb
from numpy.random import Generator
from numpy.typing import NDArray
from torch import Tensor

from kornia_tidy.data.dead_leaves import PaintedScenes, check_arguments, depth_of
from kornia_tidy.data.image_files import SUFFIXES, as_image
from kornia_tidy.data.photographic_leaves import ZOOM, of_most, photographed, scattered
from kornia_tidy.data.scene_dataset import Transform
from kornia_tidy.data.stored import read_stored
from kornia_tidy.data.transfer import tell_linear
from kornia_tidy.files import find_files

PIXELS_A_LEAF = (300.0, 40_000.0)  # of the final picture, uniform in its logarithm over the scenes
DISPLACED_SHARE = 0.5  # share of scenes with outlines of depth beside those of the image, as in depth maps of sensors
OFFSET = 3.0  # largest offset of depth along rows in pixels, as by the distance between two lenses
WAVES = (12.0, 40.0)  # pixels between the nodes of a smooth displacement, uniform in its logarithm
WAVE, RAGGED = 1.5, 0.7  # standard deviations in pixels of that displacement, and of one for each pixel
GRAINY_SHARE = 0.5  # share of scenes with grain, as in pictures of small sensors
GRAIN = (0.002, 0.012)  # its standard deviation in the encoded picture, uniform in its logarithm
GRAIN_SIZE = (0.3, 3.0)  # standard deviation in pixels of the blur that made it coarse, uniform in its logarithm
GRAIN_COLOR = 0.5  # share of its variance that is not common to the colours
MOST_PHOTOGRAPHS = 4  # that a scene shows
REDUCTION = (1.0, 3.0)  # of a photograph's sides, uniform in its logarithm
CONTRAST = (0.2, 1.0)  # of a leaf's texture with its surroundings in the photograph, uniform over the leaves
BLANK_SHARE = 0.2  # share of leaves without texture, which are smoothly shaded as walls are
AROUND = 16  # painted pixels over which the surroundings are averaged
EXPOSURE, TINT = 0.25, 0.15  # standard deviations of the logarithms of a leaf's light and of its three colours


def photo_collage(
    photographs: Sequence[str | os.PathLike[str]],
    height: int,
    width: int,
    *,
    depth_range: tuple[float, float] = (0.3, 10.0),
    seed: int = 0,
) -> tuple[Tensor, Tensor]:
    """Paint a dead-leaves scene whose shapes show parts of photographs, with the depth of every pixel.

    Shapes and depths are those of :func:`~kornia_tidy.data.dead_leaves.dead_leaves`, sampling and softness those of
    :func:`~kornia_tidy.data.photographic_leaves.photographic_leaves`. A scene shows up to four photographs, reduced to
    a third of their sides or more, in one shape for 300 to 40,000 pixels. Shapes differ in exposure, tint and the
    contrast of their texture; a fifth has none, only the light around it. Depth is independent of the photographs'
    content, so that a network can learn it only from defocus. In half of the scenes outlines of depth lie some pixels
    beside those of the image, as in the depth maps of sensors, and half have grain, as pictures of small sensors.

    Args:
        photographs: paths of files that :func:`~kornia_tidy.data.image_files.read_image` reads, in sRGB, all of them
            in focus. A photograph that is smaller than the scene is enlarged.
        height: rows in pixels.
        width: columns in pixels.
        depth_range: nearest and farthest depth in metres; the farthest may be ``inf``.
        seed: of all that is random. The scene does not depend on the global generators or the number of threads.

    Returns:
        The image, :math:`(3, H, W)` float32, sRGB-encoded in [0, 1], and the depth, :math:`(1, H, W)` float32, metres.

    Raises:
        FileNotFoundError: if a photograph that the scene shows is missing.
        ValueError: if the photographs are missing or one cannot be read, or as
            :func:`~kornia_tidy.data.photographic_leaves.photographic_leaves` does.

    Convention:
        The depth of a pixel is that of the surface that fills most of it, of the nearer one if two are equal; depths
        are not mixed. Light beyond full scale is clipped, as by a sensor.

    Source: Lee, Mumford and Huang, Occlusion models for natural images, IJCV 41 (2001); Mayer et al., A large dataset
    to train convolutional networks, CVPR 2016 (photographs on objects of random depth).

    Example:
        >>> import tempfile
        >>> from kornia_tidy.data import write_image
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_image(f"{folder}/wall.png", torch.rand(3, 90, 120))
        ...     image, depth = photo_collage([f"{folder}/wall.png"], 48, 64, depth_range=(0.5, float("inf")), seed=1)
        >>> image.shape, depth.shape, bool(depth.min() >= 0.5)
        (torch.Size([3, 48, 64]), torch.Size([1, 48, 64]), True)
    """
    check_arguments(height, width, depth_range, 1, seed)
    if not photographs:
        raise ValueError("photographs must hold one path or more, got none")
    near, far = depth_range
    rng = np.random.default_rng(seed)
    _, index, inverse_depth = scattered(height, width, rng, PIXELS_A_LEAF)
    image = photographed(_collage(index, photographs, rng).clip(0, 1), rng)

    inverse_depth = of_most(inverse_depth)
    if rng.random() < DISPLACED_SHARE:
        inverse_depth = displaced(inverse_depth, rng)
    depth = depth_of(inverse_depth, near, far)
    encoded = linear_rgb_to_rgb(torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))[None])[0]
    if rng.random() < GRAINY_SHARE:
        encoded = encoded + torch.from_numpy(grain(height, width, rng))
    return encoded.clamp(0, 1), torch.from_numpy(depth[None])


class PhotoCollages(PaintedScenes):
    """Data set of collages of photographs. See :func:`photo_collage`.

    Args:
        photographs: paths, see :func:`photographs_in`.
        length: number of scenes.
        height: rows in pixels.
        width: columns in pixels.
        depth_range: nearest and farthest depth in metres; the farthest may be ``inf``.
        seed: data sets of different seeds share no scene, but scenes of the same photographs show the same things: use
            some photographs for training and others for testing.
        transform: see :class:`~kornia_tidy.data.scene_dataset.SceneDataset`, which also describes the items.

    Raises:
        ValueError: if the length is not a positive integer, or as :func:`photo_collage` does.

    Example:
        >>> import tempfile
        >>> from kornia_tidy.data import write_image
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_image(f"{folder}/wall.png", torch.rand(3, 90, 120))
        ...     scenes = PhotoCollages(photographs_in(folder), 1000, 48, 64)
        ...     len(scenes), scenes[7]["image"].shape, scenes[7]["name"]
        (1000, torch.Size([3, 48, 64]), 'photo collage 0/7')
    """

    kind = key = "photo collage"

    def __init__(
        self,
        photographs: Sequence[str | os.PathLike[str]],
        length: int,
        height: int,
        width: int,
        *,
        depth_range: tuple[float, float] = (0.3, 10.0),
        seed: int = 0,
        transform: Transform | None = None,
    ) -> None:
        super().__init__(length, height, width, depth_range=depth_range, seed=seed, transform=transform)
        if not photographs:
            raise ValueError("photographs must hold one path or more, got none")
        self.photographs = [Path(path) for path in photographs]

    def paint(self, seed: int) -> tuple[Tensor, Tensor]:
        """Return image and depth of the scene of a seed."""
        return photo_collage(self.photographs, self.height, self.width, depth_range=self.depth_range, seed=seed)


def photographs_in(folder: str | os.PathLike[str]) -> list[Path]:
    """Return the PNG, TIFF and JPEG files in a folder and the folders in it, in the order of their paths.

    Args:
        folder: where to look; hidden files are passed by.

    Raises:
        FileNotFoundError: if the folder is missing or holds none of these files.
    """
    root = Path(folder)
    if not root.is_dir():
        raise FileNotFoundError(f"there is no folder {root}: it must hold photographs ({', '.join(SUFFIXES)})")
    found = sorted(path for path in find_files(root, "**/*") if path.suffix.lower() in SUFFIXES)
    if not found:
        raise FileNotFoundError(f"{root} holds no photographs ({', '.join(SUFFIXES)})")
    return found


def displaced(plane: NDArray[Any], rng: Generator) -> NDArray[Any]:
    """Move the outlines of a plane (H, W) by a few pixels: all of them alike, in smooth waves, and raggedly.

    Depth maps of sensors are so: another lens saw them, holes at outlines were filled, and edges are ragged. No values
    are mixed.

    Args:
        plane: such as inverse depth.
        rng: of all that is random.

    Example:
        >>> plane = np.repeat([[0.0, 1.0]], 64, 1).repeat(128, 0)
        >>> moved = displaced(plane, np.random.default_rng(0))
        >>> set(moved.flat) == {0.0, 1.0}, bool((moved != plane).any())
        (True, True)
    """
    rows, columns = plane.shape
    spacing = WAVES[0] * (WAVES[1] / WAVES[0]) ** rng.random()
    nodes = rng.normal(0, WAVE, (round(rows / spacing) + 2, round(columns / spacing) + 2, 2))
    waves = cv2.resize(nodes, (columns, rows), interpolation=cv2.INTER_CUBIC)
    moved = waves + rng.normal(0, RAGGED, (rows, columns, 2)) + np.array([rng.uniform(-OFFSET, OFFSET), 0.0])
    across, along = np.meshgrid(np.arange(columns), np.arange(rows))
    place = np.rint(moved).astype(np.intp)
    return plane[(along + place[..., 1]).clip(0, rows - 1), (across + place[..., 0]).clip(0, columns - 1)]


def grain(height: int, width: int, rng: Generator) -> NDArray[np.float32]:
    """Return grain of an encoded picture, (3, H, W): normal, of one strength and size, in part common to the colours.

    Demosaicking and compression made it coarse. A network that seldom saw grain takes it for texture.

    Args:
        height: rows in pixels.
        width: columns in pixels.
        rng: of all that is random.

    Example:
        >>> drawn = grain(64, 64, np.random.default_rng(0))
        >>> drawn.shape, bool(GRAIN[0] <= drawn.std() <= GRAIN[1])
        ((3, 64, 64), True)
    """
    strength, size = (least * (most / least) ** rng.random() for least, most in (GRAIN, GRAIN_SIZE))
    common, own = rng.normal(size=(height, width, 1)), rng.normal(size=(height, width, 3))
    drawn = math.sqrt(1 - GRAIN_COLOR) * common + math.sqrt(GRAIN_COLOR) * own
    drawn = cv2.GaussianBlur(drawn, (0, 0), size)
    return (strength / drawn.std() * drawn).transpose(2, 0, 1).astype(np.float32)


def _collage(
    index: NDArray[np.int32], photographs: Sequence[str | os.PathLike[str]], rng: Generator
) -> NDArray[np.float32]:
    """Return the linear light of leaves, (H, W, 3); each leaf shows its place in one of a few photographs."""
    shown = rng.choice(len(photographs), min(len(photographs), 1 + rng.integers(MOST_PHOTOGRAPHS)), replace=False)
    leaves = int(index.max()) + 1
    photograph = rng.integers(len(shown), size=leaves)
    gain = np.exp(rng.normal(0, EXPOSURE, (leaves, 1)) + rng.normal(0, TINT, (leaves, 3))).astype(np.float32)
    contrast = rng.uniform(*CONTRAST, (leaves, 1)).astype(np.float32)
    contrast[rng.random(leaves) < BLANK_SHARE] = 0
    light = np.empty((*index.shape, 3), np.float32)
    for number, place in enumerate(shown):
        draws = rng.random(4)  # however many leaves show it, if any
        here = photograph[index] == number
        if here.any():
            cut = _cut(photographs[place], *index.shape, draws)
            around = _surroundings(cut)[here]
            light[here] = around + contrast[index[here]] * (cut[here] - around)
    return light * gain[index]


def _surroundings(light: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the mean light around each painted pixel, interpolated between the means of squares."""
    rows, columns = light.shape[:2]
    small = cv2.resize(light, (-(-columns // AROUND), -(-rows // AROUND)), interpolation=cv2.INTER_AREA)
    return cv2.resize(small, (columns, rows), interpolation=cv2.INTER_LINEAR).astype(np.float32, copy=False)


def _cut(path: str | os.PathLike[str], height: int, width: int, draws: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return linear light of a part of a photograph, (H, W, 3), reduced, at a place and mirrored by four draws."""
    stored = read_stored(path)
    tell_linear(path, stored.linear)
    photograph = as_image(stored, path)  # in any orientation, and without a word about it
    rows, columns = photograph.shape[-2:]
    largest = min(rows / height, columns / width)  # photograph's pixels along one that is painted
    least, most = (min(largest, value / ZOOM) for value in REDUCTION)
    reduction = least * (most / least) ** draws[0]
    high, wide = max(1, round(height * reduction)), max(1, round(width * reduction))
    top, left = round(draws[1] * (rows - high)), round(draws[2] * (columns - wide))
    part = photograph[:, top : top + high, left : left + wide].expand(3, -1, -1)
    light = rgb_to_linear_rgb(part[None])[0].numpy().transpose(1, 2, 0)
    kind = cv2.INTER_AREA if reduction > 1 else cv2.INTER_LINEAR
    painted = cv2.resize(np.ascontiguousarray(light), (width, height), interpolation=kind).astype(np.float32)
    return painted[:, ::-1] if draws[3] < 0.5 else painted
