"""Colours, textures and light of leaves with the statistics of photographs, in linear light."""

from __future__ import annotations

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

from kornia_tidy.data.leaf_textures import (
    SCRIPT,
    TEXTURES,
    Array,
    LeafPixels,
    Leaves,
    leaf_pixels,
    make_noise_tile,
    make_script_tile,
    pattern_weights,
    read_tile,
)

# Natural logarithms of linear light: mean and standard deviation of a scene's mean, standard deviation of its leaves
# around that. These and the sizes of textures were set by hand to bring the statistics of 16 photographs, half A of
# the real scenes (docs/record/benchmarks.md).
LUMINANCE = (-1.95, 0.6, 0.85)
RED_OVER_BLUE = (0.5, 0.35, 0.5)
GREEN_OVER_MAGENTA = (0.0, 0.2, 0.25)
WARM_SHADOWS = -0.35  # correlation of red over blue with luminance, within a scene
PATTERN = 0.8  # standard deviation of the logarithm of a pattern's contrast
NOISE_EXPONENT = 1.45  # of the amplitude of cloudy textures: the power of light falls as f^-2.9 in photographs
PLAIN = 0.4  # share of leaves without a pattern, as walls and tables
GRAIN = (0.03, 0.5)  # standard deviation of the logarithm of fine texture, uniform in its own logarithm over leaves
GRAIN_SIZE = (0.5, 2.0)  # enlargement of that texture
# Shares of the textures, in the order of TEXTURES: two plain, two cloudy, two with veins, then stripes, checks, script,
# spots and rings.
WEIGHTS = (1.0, 1.0, 3.0, 3.0, 0.5, 0.5, 1.0, 1.0, 0.7, 0.7, 0.7)
SHADING = 0.35  # largest relative change of light from the middle of a leaf to its edge
ILLUMINATION = 0.35  # standard deviation of the logarithm of a scene's illumination
ILLUMINATION_CELLS = 4  # along a side; it is smooth between them


def photographic_light(index: NDArray[np.int32], leaves: Leaves, zoom: int, rng: Generator) -> Array:
    """Return the light from a picture of leaves.

    Args:
        index: number of the leaf that each pixel shows, (H, W).
        leaves: places, sizes and angles of the leaves.
        zoom: pixels painted for one of the final picture, whose pixels bound the fineness of textures.
        rng: generator of colours and textures.

    Returns:
        Linear light, (H, W, 3) RGB; it exceeds 1, full scale, where the scene has highlights.

    Source: Ruderman, Cronin and Chiao, Statistics of cone responses to natural images, JOSA A 15 (1998): logarithms of
    light have independent axes of luminance, blue-yellow and red-green with long tails.
    """
    height, width = index.shape
    count = len(leaves.radius)
    base = _log_colours(count, rng)
    change = np.stack([rng.normal(0, PATTERN, count), rng.laplace(0, 0.1, count), rng.laplace(0, 0.05, count)], 1)
    kind = rng.choice(len(TEXTURES), count, p=np.array(WEIGHTS) / sum(WEIGHTS))
    contrast = (rng.random(count) > PLAIN) * rng.beta(2, 2, count)
    writing = kind == SCRIPT
    change[writing, 0] = -np.abs(rng.normal(1.2, 0.5, count))[writing]  # dark on bright
    contrast[writing] = 1
    style = rng.random((3, count), dtype=np.float32)
    shading = rng.uniform(0, SHADING, count).astype(np.float32)
    direction = rng.uniform(0, 2 * np.pi, count).astype(np.float32)
    grain, grain_size = (low * (high / low) ** rng.random(count, np.float32) for low, high in (GRAIN, GRAIN_SIZE))
    noise_tile, script_tile = make_noise_tile(rng, NOISE_EXPONENT), make_script_tile(rng)
    grain_tile = make_noise_tile(rng)

    pixels = leaf_pixels(index, leaves)
    leaf, x, y, along, across, size = pixels
    final = LeafPixels(
        leaf, x, y, *((position / zoom).astype(np.float32, copy=False) for position in (along, across, size))
    )
    pattern = pattern_weights(final, kind, style, noise_tile, script_tile)
    pattern *= contrast.astype(np.float32)[leaf]
    slope = shading[leaf] * (np.cos(direction)[leaf] * x + np.sin(direction)[leaf] * y) / size
    log_light = slope.clip(-2, 2) + _illumination(height, width, rng).ravel()
    fine = zoom * grain_size[leaf]
    log_light += grain[leaf] * read_tile(grain_tile, along / fine + 97 * style[0, leaf], across / fine)
    logs = (base @ TO_RGB).astype(np.float32)[leaf]
    logs += pattern[:, None] * (change @ TO_RGB).astype(np.float32)[leaf]
    logs += log_light[:, None]
    return np.exp(logs).reshape(height, width, 3)


# Rows: mean of the three logarithms; log(R / B); log(G / sqrt(R B)).
TO_RGB = np.array([[1.0, 1.0, 1.0], [0.5, 0.0, -0.5], [-1 / 3, 2 / 3, -1 / 3]])


def _log_colours(count: int, rng: Generator) -> NDArray[np.float64]:
    """Return luminance, red over blue and green over magenta of leaves, (N, 3) natural logarithms."""
    scene = [rng.normal(mean, spread) for mean, spread, _ in (LUMINANCE, RED_OVER_BLUE, GREEN_OVER_MAGENTA)]
    luminance = rng.normal(0, LUMINANCE[2], count)
    own = np.sqrt(1 - WARM_SHADOWS**2) * rng.laplace(0, np.sqrt(0.5), count)  # of unit standard deviation
    red = RED_OVER_BLUE[2] * (WARM_SHADOWS * luminance / LUMINANCE[2] + own)
    green = GREEN_OVER_MAGENTA[2] * rng.laplace(0, np.sqrt(0.5), count)
    return np.stack([luminance, red, green], 1) + scene


def _illumination(height: int, width: int, rng: Generator) -> Array:
    """Return the logarithm of the illumination of a scene, (H, W): smooth, of random strength."""
    cells = rng.normal(0, ILLUMINATION * rng.random(), (ILLUMINATION_CELLS + 3, ILLUMINATION_CELLS + 3))
    rows, columns = (spline_weights(side) for side in (height, width))
    return (rows @ cells @ columns.T).astype(np.float32)


def spline_weights(side: int) -> NDArray[np.float64]:
    """Return the weights of uniform cubic B-splines at the pixels of a side, (side, ILLUMINATION_CELLS + 3)."""
    place = (np.arange(side) + 0.5) / side * ILLUMINATION_CELLS
    distance = np.abs(place[:, None] + 1 - np.arange(ILLUMINATION_CELLS + 3))
    near = 2 / 3 - distance**2 + distance**3 / 2
    return np.where(distance < 1, near, (2 - distance).clip(0) ** 3 / 6)
