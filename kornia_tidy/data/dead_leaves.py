"""Dead leaves: procedural scenes with exact depth and the statistics of natural images."""

from __future__ import annotations

import math
from abc import abstractmethod
from typing import ClassVar

import cv2
import numpy as np
import torch
from numpy.random import Generator
from numpy.typing import NDArray
from torch import Tensor

from kornia_tidy.checks import check_count
from kornia_tidy.data.leaf_textures import Leaves, paint_leaves
from kornia_tidy.data.picture_header import check_pixels
from kornia_tidy.data.rgbd import Scene
from kornia_tidy.data.scene_dataset import SceneDataset, Transform
from kornia_tidy.seeds import keyed_seed

PIXELS_A_LEAF, MOST_LEAVES = 256, 3000  # of scenes in a data set: sizes as in photographs
COVERAGE = 3.0  # mean number of leaves over a pixel; exp(-3) = 5 % of the picture shows the background
LARGEST_RADIUS = 0.5  # of the picture's geometric mean side
SMALLEST_LEAF = 1.0  # px: a smaller leaf would fall between pixels
MOST_FAR = 3.0  # largest exponent of normalised inverse depth; drawn from 1 to this, uniform in its logarithm
LARGEST_SLANT = 0.08  # fraction of the dioptre range, from the middle of a leaf to its edge
OUTLINE_POINTS = 120  # divisible by 3, 4, 5 and 6, so that every corner of a polygon is a point
PEN = 0.6  # px by which cv2.fillPoly grows a shape, since it fills every pixel on the outline
SUBPIXEL_BITS = 4  # cv2 draws with fixed-point coordinates


def dead_leaves(
    height: int,
    width: int,
    *,
    depth_range: tuple[float, float] = (0.3, 10.0),
    num_leaves: int = 3000,
    seed: int = 0,
) -> tuple[Tensor, Tensor]:
    r"""Paint a dead-leaves scene: textured shapes that occlude each other, with the depth of every pixel.

    Shapes (ellipses, pebbles, polygons, leaves) have radii of density :math:`\propto r^{-3}`, which gives the power
    spectrum (:math:`1/f^2`) and the heavy-tailed gradients of natural images. Their normalised inverse depth is
    :math:`u^\gamma`. u has the density :math:`\propto 1 / (b + (1 - b) u)`, where b is the fraction of the picture that
    shows the background: near leaves hide far ones, and with this density visible pixels are uniform in u. With
    :math:`\gamma = 1` they are uniform in dioptres and so in defocus. :math:`\gamma` varies from scene to scene
    between 1 and 3, as most of a natural scene is far: the mean of the normalised inverse depth is 0.35 here and 0.36
    in 35 photographs with known depth.

    Size, colour and texture do not depend on depth: only occlusion and defocus tell the depth of a leaf.

    Args:
        height: rows in pixels.
        width: columns in pixels.
        depth_range: nearest and farthest depth in metres; the farthest may be ``inf``.
        num_leaves: number of shapes. Their total area is fixed, so that more leaves are smaller.
        seed: of all that is random. The scene does not depend on the global generators or the number of threads.

    Returns:
        The image, :math:`(3, H, W)` float32, sRGB-encoded in [0, 1], and the depth, :math:`(1, H, W)` float32, metres.

    Raises:
        ValueError: if a size or the number of leaves is not a positive integer, the seed is negative, or the depth
            range is not 0 < near < far.

    Convention:
        - Every pixel shows one surface: outlines are not anti-aliased, so that edges in depth and image coincide. For
          soft edges paint at twice the size and average the image.
        - Leaves are planes, a third of them slanted (inverse depth is affine in x and y, as in perspective). Where two
          planes cross, the nearer one is visible. The background is a plane at the far end.

    Source: Matheron, Random Sets and Integral Geometry (1975); Lee, Mumford and Huang, Occlusion models for natural
    images, IJCV 41 (2001).

    Example:
        >>> image, depth = dead_leaves(48, 64, depth_range=(0.5, float("inf")), num_leaves=200, seed=1)
        >>> image.shape, depth.shape
        (torch.Size([3, 48, 64]), torch.Size([1, 48, 64]))
        >>> bool(depth.min() >= 0.5), bool(depth.isinf().any())
        (True, True)
    """
    check_arguments(height, width, depth_range, num_leaves, seed)
    near, far = depth_range
    rng = np.random.default_rng(seed)
    leaves = scatter_leaves(height, width, num_leaves, rng)
    index, inverse_depth = rasterise(height, width, leaves)
    image = paint_leaves(index, leaves, rng)

    depth = depth_of(inverse_depth, near, far)
    return torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1))), torch.from_numpy(depth[None])


def depth_of(inverse_depth: NDArray[np.float64], near: float, far: float) -> NDArray[np.float32]:
    """Return depth in metres from normalised inverse depth; the far end may be infinite.

    Example:
        >>> depth_of(np.array([0.0, 0.5, 1.0]), 0.5, math.inf)
        array([inf, 1. , 0.5], dtype=float32)
    """
    dioptres = 1 / far + (1 / near - 1 / far) * inverse_depth
    depth = np.full_like(dioptres, np.inf)
    np.divide(1.0, dioptres, out=depth, where=dioptres > 0)
    return depth.astype(np.float32).clip(near, far)


class PaintedScenes(SceneDataset):
    """Base class of data sets of scenes that are painted on access and not stored; each has its own seed.

    Subclasses name their scenes, and paint them by :meth:`paint`. For arguments see :class:`DeadLeaves`.
    """

    kind: ClassVar[str]
    key: ClassVar[str]  # of the seeds of scenes

    def __init__(
        self,
        length: int,
        height: int,
        width: int,
        *,
        depth_range: tuple[float, float] = (0.3, 10.0),
        seed: int = 0,
        transform: Transform | None = None,
    ) -> None:
        super().__init__(transform)
        check_count("length", length)
        check_arguments(height, width, depth_range, 1, seed)
        self.length, self.height, self.width = length, height, width
        self.depth_range, self.seed = depth_range, seed

    @abstractmethod
    def paint(self, seed: int) -> tuple[Tensor, Tensor]:
        """Return image and depth of the scene of a seed."""

    def __len__(self) -> int:
        """Return the number of scenes."""
        return self.length

    def name(self, index: int) -> str:
        """Return the seed and the number of a scene."""
        return f"{self.kind} {self.seed}/{index}"

    def read(self, index: int) -> Scene:
        """Paint a scene."""
        return Scene.whole(*self.paint(keyed_seed(self.seed, self.key, index)))


class DeadLeaves(PaintedScenes):
    """Data set of dead-leaves scenes, painted on access and not stored. See :func:`dead_leaves`.

    Args:
        length: number of scenes.
        height: rows in pixels.
        width: columns in pixels.
        depth_range: nearest and farthest depth in metres; the farthest may be ``inf``.
        num_leaves: number of shapes in a scene. Default: one for 256 pixels, and 3000 at most.
        seed: data sets of different seeds share no scene: use one for training and another for testing.
        transform: see :class:`~kornia_tidy.data.scene_dataset.SceneDataset`, which also describes the items.

    Raises:
        ValueError: if the length is not a positive integer, or as :func:`dead_leaves` does.

    Example:
        >>> scenes = DeadLeaves(1000, 48, 64, num_leaves=200)
        >>> len(scenes), scenes[7]["image"].shape, scenes[7]["name"]
        (1000, torch.Size([3, 48, 64]), 'dead leaves 0/7')
    """

    kind, key = "dead leaves", "scene"

    def __init__(
        self,
        length: int,
        height: int,
        width: int,
        *,
        depth_range: tuple[float, float] = (0.3, 10.0),
        num_leaves: int | None = None,
        seed: int = 0,
        transform: Transform | None = None,
    ) -> None:
        super().__init__(length, height, width, depth_range=depth_range, seed=seed, transform=transform)
        default = min(MOST_LEAVES, max(1, height * width // PIXELS_A_LEAF))
        self.num_leaves = default if num_leaves is None else num_leaves
        check_arguments(height, width, depth_range, self.num_leaves, seed)

    def paint(self, seed: int) -> tuple[Tensor, Tensor]:
        """Return image and depth of the scene of a seed."""
        size, leaves = (self.height, self.width), self.num_leaves
        return dead_leaves(*size, depth_range=self.depth_range, num_leaves=leaves, seed=seed)


def check_arguments(height: int, width: int, depth_range: tuple[float, float], num_leaves: int, seed: int) -> None:
    """Raise ``ValueError`` for arguments of :func:`dead_leaves` that are not allowed."""
    for name, value in (("height", height), ("width", width), ("num_leaves", num_leaves)):
        check_count(name, value)
    check_pixels("the scene", height, width)
    near, far = depth_range
    if not (0 < near < far and math.isfinite(near)):
        raise ValueError(f"depth_range must be (near, far) in metres with 0 < near < far, got {depth_range}")
    check_count("seed", seed, least=0)


def scatter_leaves(
    height: int, width: int, count: int, rng: Generator, largest_radius: float = LARGEST_RADIUS
) -> Leaves:
    """Draw places, sizes, depths and outlines of leaves that cover a picture.

    Args:
        height: rows in pixels.
        width: columns in pixels.
        count: number of leaves; their total area is fixed.
        rng: source of all draws.
        largest_radius: of a leaf, in units of the picture's geometric mean side.
    """
    largest = max(largest_radius * math.sqrt(height * width), 2 * SMALLEST_LEAF)
    smallest = _smallest_radius(height, width, count, largest)
    radius = _radius_at(rng.random(count), height, width, smallest, largest)
    # Centres lie wherever a leaf touches the picture, so that the border is covered like the middle.
    center = rng.uniform(-1, 1, (count, 2)) * (np.array([width, height]) / 2 + radius[:, None])
    center += np.array([width - 1, height - 1]) / 2

    background = math.exp(-_coverage(height, width, count, smallest, largest))
    visible_below = background ** rng.random(count)  # fraction of the picture that is to show farther leaves
    inverse_depth = np.sort((visible_below - background) / (1 - background)) ** (MOST_FAR ** rng.random())

    angle = rng.uniform(0, 2 * math.pi, count)
    slant = np.where(rng.random(count) < 1 / 3, rng.uniform(0, LARGEST_SLANT, count), 0.0)
    slant = np.minimum(slant, np.minimum(inverse_depth, 1 - inverse_depth)) / radius  # stays within the depth range
    direction = rng.uniform(0, 2 * math.pi, count)
    outline = _outlines(angle, radius, rng) + center[:, None]

    middle = np.array([[(width - 1) / 2, (height - 1) / 2]])
    frame = np.resize(np.array([[-1, -1], [width, -1], [width, height], [-1, height]], float), (1, OUTLINE_POINTS, 2))
    return Leaves(
        center=np.concatenate([middle, center]),
        radius=np.concatenate([[math.hypot(height, width) / 2], radius]),
        angle=np.concatenate([[0.0], angle]),
        inverse_depth=np.concatenate([[0.0], inverse_depth]),
        slant=np.concatenate([np.zeros((1, 2)), slant[:, None] * np.stack([np.cos(direction), np.sin(direction)], 1)]),
        outline=np.concatenate([frame, outline]),
    )


def _coverage(height: int, width: int, count: int, smallest: float, largest: float) -> float:
    """Return the mean number of leaves over a pixel, for radii of density r^-3 and centres wherever a leaf touches."""
    centers = (
        height * width * (smallest**-2 - largest**-2) / 2
        + 2 * (height + width) * (1 / smallest - 1 / largest)
        + 4 * math.log(largest / smallest)
    )
    return count * math.pi * math.log(largest / smallest) / centers


def _smallest_radius(height: int, width: int, count: int, largest: float) -> float:
    """Return the smallest radius for which ``count`` leaves give the wanted coverage, by bisection."""
    low, high = SMALLEST_LEAF, 0.99 * largest
    for _ in range(50):
        middle = math.sqrt(low * high)
        low, high = (low, middle) if _coverage(height, width, count, middle, largest) > COVERAGE else (middle, high)
    return low


def _radius_at(
    rank: NDArray[np.float64], height: int, width: int, smallest: float, largest: float
) -> NDArray[np.float64]:
    """Return quantiles of the radii: density r^-3 on the picture, times the area from which a leaf reaches it."""
    grid = np.geomspace(smallest, largest, 1025)
    density = grid**-3 * (width + 2 * grid) * (height + 2 * grid)
    share = np.concatenate([[0.0], np.cumsum((density[1:] + density[:-1]) / 2 * np.diff(grid))])
    return np.interp(rank * share[-1], share, grid)


def _outlines(angle: NDArray[np.float64], radius: NDArray[np.float64], rng: Generator) -> NDArray[np.float64]:
    """Return closed outlines (N, OUTLINE_POINTS, 2) around the origin, of the area of a disc of their radius."""
    count = len(angle)
    turn = np.linspace(0, 2 * math.pi, OUTLINE_POINTS, endpoint=False)
    pebble = np.ones((count, OUTLINE_POINTS))
    for wave in (2, 3, 5):
        size = rng.normal(0, 0.22 / wave, (count, 1))
        pebble += size * np.cos(wave * turn + rng.uniform(0, 2 * math.pi, (count, 1)))
    sides = rng.choice([3, 4, 4, 5, 6], (count, 1))
    polygon = 1 / np.cos(turn % (2 * math.pi / sides) - math.pi / sides)
    kind = rng.choice(4, (count, 1), p=[0.3, 0.2, 0.2, 0.3])
    ray = np.choose(kind, [np.ones_like(pebble), pebble.clip(0.3), polygon, np.ones_like(pebble)])
    x, y = ray * np.cos(turn), ray * np.sin(turn)
    leaf_half_width = np.abs(np.sin(turn)) * (1 - 0.35 * np.cos(turn))  # two sharp tips, broader towards the stem
    y = np.where(kind == 3, 0.9 * y * leaf_half_width, y)
    y *= np.exp(rng.uniform(-0.6, 0, (count, 1)))

    area = np.abs((x * np.roll(y, -1, 1) - y * np.roll(x, -1, 1)).sum(1, keepdims=True)) / 2
    scale = (radius[:, None] - PEN) * np.sqrt(math.pi / area)
    cos, sin = np.cos(angle)[:, None], np.sin(angle)[:, None]
    return np.stack([scale * (cos * x - sin * y), scale * (sin * x + cos * y)], axis=-1)


def rasterise(height: int, width: int, leaves: Leaves) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Return the visible leaf of each pixel and its normalised inverse depth, painted from far to near."""
    index = np.zeros((height, width), np.int32)
    inverse_depth = np.full((height, width), -1.0)
    corner = np.floor(leaves.outline.min(1)).astype(int).clip(0)
    end = np.ceil(leaves.outline.max(1)).astype(int) + 1
    end = np.minimum(end, [width, height])
    points = np.rint((leaves.outline - corner[:, None]) * 2**SUBPIXEL_BITS).astype(np.int32)
    at_corner = leaves.inverse_depth + ((corner - leaves.center) * leaves.slant).sum(1)
    columns, rows = np.arange(width, dtype=float), np.arange(height, dtype=float)[:, None]
    boxes = np.concatenate([corner, end], 1).tolist()
    for leaf, (x0, y0, x1, y1) in enumerate(boxes):
        if x0 >= x1 or y0 >= y1:
            continue
        mask = np.zeros((y1 - y0, x1 - x0), np.uint8)
        cv2.fillPoly(mask, [points[leaf]], 1, shift=SUBPIXEL_BITS)
        slant_x, slant_y = leaves.slant[leaf]
        plane = at_corner[leaf] + slant_x * columns[: x1 - x0] + slant_y * rows[: y1 - y0]
        below = inverse_depth[y0:y1, x0:x1]
        seen = mask.view(bool) & (plane > below)
        np.copyto(below, plane, where=seen)
        np.copyto(index[y0:y1, x0:x1], leaf, where=seen)
    return index, inverse_depth.clip(0, 1)  # an outline can reach beyond its radius
