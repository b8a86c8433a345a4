"""Dead leaves with the statistics of photographs: anti-aliased, softened by a lens, with large and blank objects."""

from __future__ import annotations

import cv2
import numpy as np
import torch
from kornia.color import linear_rgb_to_rgb
from numpy.random import Generator
from numpy.typing import NDArray
from torch import Tensor

from kornia_tidy.data.dead_leaves import PaintedScenes, check_arguments, depth_of, rasterise, scatter_leaves
from kornia_tidy.data.leaf_textures import Leaves
from kornia_tidy.data.photographic_textures import photographic_light

ZOOM = 2  # painted pixels along a side of a final one
PIXELS_A_LEAF = (150.0, 6000.0)  # of the final picture, uniform in its logarithm over the scenes: few or many objects
LARGEST_RADIUS = 0.8  # of the picture's geometric mean side
SOFT_SHARE = 0.5  # share of scenes that are softened
SOFTNESS = (0.3, 0.9)  # standard deviation in pixels


def photographic_leaves(
    height: int, width: int, *, depth_range: tuple[float, float] = (0.3, 10.0), seed: int = 0
) -> tuple[Tensor, Tensor]:
    """Paint a dead-leaves scene with the statistics of photographs, with the depth of every pixel.

    Shapes and depths are those of :func:`~kornia_tidy.data.dead_leaves.dead_leaves`. Different are:

    - sampling: the scene is painted at twice the size and averaged in linear light, as by the area of a sensor's
      pixels, and half of the scenes are softened by a Gaussian of 0.3 to 0.9 px, as by a lens;
    - size: scenes have between one shape in 150 pixels and one in 6,000, and shapes up to 0.8 sides in radius;
    - colour: logarithms of linear light have the means and spreads of photographs, scene by scene;
    - texture: half of the shapes are blank, and most others cloudy, with the power spectrum of photographs
      (:math:`f^{-2.9}`); stripes, writing and other patterns are few;
    - light: shapes are shaded smoothly, and the illumination varies smoothly over the scene.

    ``docs/record/benchmarks.md`` tells how like photographs the scenes are.

    Args:
        height: rows in pixels.
        width: columns in pixels.
        depth_range: nearest and farthest depth in metres; the farthest may be ``inf``.
        seed: of all that is random. The scene does not depend on the global generators or the number of threads.

    Returns:
        The image, :math:`(3, H, W)` float32, sRGB-encoded in [0, 1], and the depth, :math:`(1, H, W)` float32, metres.

    Raises:
        ValueError: if a size is not a positive integer, the seed is negative, or the depth range is not
            0 < near < far.

    Convention:
        The depth of a pixel is that of the surface that fills most of it, of the nearer one if two are equal; depths
        are not mixed. Light beyond full scale is clipped, as by a sensor.

    Source: Lee, Mumford and Huang, Occlusion models for natural images, IJCV 41 (2001); Ruderman, Cronin and Chiao,
    Statistics of cone responses to natural images, JOSA A 15 (1998).

    Example:
        >>> image, depth = photographic_leaves(48, 64, depth_range=(0.5, float("inf")), seed=1)
        >>> image.shape, depth.shape, bool(depth.min() >= 0.5)
        (torch.Size([3, 48, 64]), torch.Size([1, 48, 64]), True)
    """
    check_arguments(height, width, depth_range, 1, seed)
    near, far = depth_range
    rng = np.random.default_rng(seed)
    leaves, index, inverse_depth = scattered(height, width, rng, PIXELS_A_LEAF)
    light = photographic_light(index, leaves, ZOOM, rng)
    image = photographed(light.clip(0, 1), rng)

    depth = depth_of(of_most(inverse_depth), near, far)
    encoded = linear_rgb_to_rgb(torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))[None])[0]
    return encoded.clamp(0, 1), torch.from_numpy(depth[None])


class PhotographicLeaves(PaintedScenes):
    """Data set of dead-leaves scenes with the statistics of photographs. See :func:`photographic_leaves`.

    Args:
        length: number of scenes.
        height: rows in pixels.
        width: columns in pixels.
        depth_range: nearest and farthest depth in metres; the farthest may be ``inf``.
        seed: data sets of different seeds share no scene: use one for training and another for testing.
        transform: see :class:`~kornia_tidy.data.scene_dataset.SceneDataset`, which also describes the items.

    Raises:
        ValueError: if the length is not a positive integer, or as :func:`photographic_leaves` does.

    Example:
        >>> scenes = PhotographicLeaves(1000, 48, 64)
        >>> len(scenes), scenes[7]["image"].shape, scenes[7]["name"]
        (1000, torch.Size([3, 48, 64]), 'photographic leaves 0/7')
    """

    kind, key = "photographic leaves", "photographic scene"

    def paint(self, seed: int) -> tuple[Tensor, Tensor]:
        """Return image and depth of the scene of a seed."""
        return photographic_leaves(self.height, self.width, depth_range=self.depth_range, seed=seed)


def scattered(
    height: int, width: int, rng: Generator, pixels_a_leaf: tuple[float, float]
) -> tuple[Leaves, NDArray[np.int32], NDArray[np.float64]]:
    """Return leaves, and the visible one and its inverse depth at each pixel of a scene of ``ZOOM`` times the size."""
    fewest, most = (height * width / pixels for pixels in reversed(pixels_a_leaf))
    count = max(1, round(fewest * (most / fewest) ** rng.random()))
    leaves = scatter_leaves(ZOOM * height, ZOOM * width, count, rng, LARGEST_RADIUS)
    return leaves, *rasterise(ZOOM * height, ZOOM * width, leaves)


def photographed(light: NDArray[np.float32], rng: Generator) -> NDArray[np.float32]:
    """Return light averaged over the final pixels, softened in a share of the scenes."""
    image = averaged(light)
    soft, place = rng.random(2)
    if soft < SOFT_SHARE:
        sigma = SOFTNESS[0] + (SOFTNESS[1] - SOFTNESS[0]) * place
        return cv2.GaussianBlur(image, (9, 9), sigma, borderType=cv2.BORDER_REFLECT).astype(np.float32, copy=False)
    return image


def averaged(light: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the mean light over each final pixel, (H, W, 3)."""
    height, width = light.shape[0] // ZOOM, light.shape[1] // ZOOM
    return light.reshape(height, ZOOM, width, ZOOM, 3).mean((1, 3))


def of_most(inverse_depth: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return for each final pixel the third of its four values from below: the surface of most, or the nearer of two.

    Example:
        >>> of_most(np.array([[0.0, 0.5], [0.5, 0.5]])), of_most(np.array([[0.5, 0.0], [0.0, 0.0]]))
        (array([[0.5]]), array([[0.]]))
    """
    height, width = inverse_depth.shape[0] // ZOOM, inverse_depth.shape[1] // ZOOM
    samples = inverse_depth.reshape(height, ZOOM, width, ZOOM).transpose(0, 2, 1, 3).reshape(height, width, ZOOM**2)
    return np.sort(samples, axis=-1)[..., ZOOM**2 // 2]
