"""Colours and textures of leaves: every pixel is shaded from the leaf it shows, all pixels at once."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import cv2
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

Array = NDArray[np.float32]

TILE = 480  # px; side of the tiles of noise and script
GLYPH = (16, 12)  # rows and columns of one glyph in the script tile, px; both divide TILE

PALETTES = (
    ("2f3e1f", "4f6228", "7a8b3a", "a8b56b", "5b4a32", "8c6f4a", "d9cfa8", "1f2a24"),  # forest
    ("7b2d1e", "b5461f", "d97a2b", "e8b04a", "5a3a22", "8f7a4e", "f0e0b8", "3a2a20"),  # autumn
    ("6fa04a", "a6c96a", "f2d64b", "e86f8a", "8a5fb0", "f7f1e3", "3e6b3a", "4f86c6"),  # meadow
    ("0f3b57", "1f6f8b", "58a6b0", "a8d5cf", "e9dcc0", "c9a77a", "f28f6b", "2b2d42"),  # sea
    ("3b3a38", "6b6862", "9a958a", "c7c0b2", "e6e0d4", "7d6a55", "a3795a", "4a5560"),  # stone
    ("5c3a4a", "b05f7a", "e5a4b4", "f6dfe0", "8aa36a", "51663f", "d7b98e", "fffaf0"),  # blossom
)
SMOOTH = 0.35  # fraction of leaves without a pattern, as walls and skies, on which defocus is invisible
ROUGHEST = 0.05  # largest standard deviation of the grain, relative to the light; most leaves have much less
STRAY_COLOURS = 0.12  # fraction of leaves with colours of another palette


class Leaves(NamedTuple):
    """Leaves sorted from far to near; entry 0 is the background."""

    center: NDArray[np.float64]  # (N, 2) x, y in px
    radius: NDArray[np.float64]  # (N,) px, of the disc with the same area
    angle: NDArray[np.float64]  # (N,) rad
    inverse_depth: NDArray[np.float64]  # (N,) normalised inverse depth at the centre, 0 = far, 1 = near end
    slant: NDArray[np.float64]  # (N, 2) gradient of inverse_depth per px along x and y
    outline: NDArray[np.float64]  # (N, points, 2) px


class LeafPixels(NamedTuple):
    """The pixels of a picture, each with its leaf and its place on it; flat arrays."""

    leaf: NDArray[np.int32]
    """Number of the leaf."""
    x: Array
    """Pixels to the right of the leaf's centre."""
    y: Array
    """Pixels below the leaf's centre."""
    along: Array
    """Pixels along the main axis of the leaf."""
    across: Array
    """Pixels across the main axis of the leaf."""
    size: Array
    """Radius of the leaf in pixels."""


def leaf_pixels(index: NDArray[np.int32], leaves: Leaves) -> LeafPixels:
    """Return the place of each pixel on the leaf that it shows, by the leaf's number, (H, W)."""
    height, width = index.shape
    leaf = index.ravel()
    x = np.tile(np.arange(width, dtype=np.float32), height) - leaves.center.astype(np.float32)[leaf, 0]
    y = np.repeat(np.arange(height, dtype=np.float32), width) - leaves.center.astype(np.float32)[leaf, 1]
    cos, sin = np.cos(leaves.angle).astype(np.float32)[leaf], np.sin(leaves.angle).astype(np.float32)[leaf]
    return LeafPixels(leaf, x, y, cos * x + sin * y, cos * y - sin * x, leaves.radius.astype(np.float32)[leaf])


def pattern_weights(
    pixels: LeafPixels, kind: NDArray[np.int64], style: Array, noise_tile: Array, script_tile: Array
) -> Array:
    """Return the weight of the second colour of its leaf in each pixel, in [0, 1].

    Args:
        pixels: of the picture.
        kind: number in :data:`TEXTURES` of each leaf's texture, (N,).
        style: three numbers in [0, 1] for each leaf, (3, N), whose meaning depends on the texture.
        noise_tile: fractal noise.
        script_tile: writing.
    """
    leaf, _, _, along, across, size = pixels
    pattern = np.zeros_like(along)
    for number, texture in enumerate(TEXTURES):
        at = np.flatnonzero((kind == number)[leaf])
        if not at.size:
            continue
        tile = script_tile if number == SCRIPT else noise_tile
        pattern[at] = texture(along[at], across[at], size[at], style[:, leaf[at]], tile)
    return pattern


def paint_leaves(index: NDArray[np.int32], leaves: Leaves, rng: Generator) -> Array:
    """Return the shaded and textured picture of leaves.

    Args:
        index: number of the leaf that each pixel shows, (H, W).
        leaves: places, sizes and angles of the leaves.
        rng: generator of colours and textures.

    Returns:
        The image, (H, W, 3) RGB, sRGB-encoded in [0, 1]. Textures are not finer than the pixels resolve.
    """
    height, width = index.shape
    count = len(leaves.radius)
    colours = _colours(count, rng)
    kind = rng.integers(0, len(TEXTURES), count)
    contrast = (rng.beta(2, 3, count) * (rng.random(count) > SMOOTH)).astype(np.float32)
    contrast[kind == SCRIPT] = 1  # writing has full contrast
    rough = (ROUGHEST * rng.random(count) ** 2).astype(np.float32)
    style = rng.random((3, count), dtype=np.float32)  # three numbers, whose meaning depends on the texture
    noise_tile, script_tile = make_noise_tile(rng), make_script_tile(rng)

    pixels = leaf_pixels(index, leaves)
    leaf, x, y, along, across, size = pixels

    # Light from the upper left on surfaces that are a little convex.
    light = 1 - np.float32(0.16) * (x + y) / size
    grain = read_tile(noise_tile, along + 97 * style[0, leaf], across + 89 * style[1, leaf])
    light *= 1 + rough[leaf] * grain

    pattern = pattern_weights(pixels, kind, style, noise_tile, script_tile) * contrast[leaf]
    first, second = colours[0][leaf], colours[1][leaf]
    image = (first + (second - first) * pattern[:, None]) * light[:, None]
    return image.clip(0, 1).reshape(height, width, 3)


def _colours(count: int, rng: Generator) -> tuple[Array, Array]:
    """Return ground and pattern colours, (N, 3) each: mixtures within one palette per scene, a few of others."""
    table = np.array([[[int(c[i : i + 2], 16) for i in (0, 2, 4)] for c in p] for p in PALETTES], np.float32) / 255
    palette = np.full(count, rng.integers(len(table)))
    stray = rng.random(count) < STRAY_COLOURS
    palette[stray] = rng.integers(len(table), size=int(stray.sum()))

    def mixture() -> Array:
        one, other = table[palette, rng.integers(8, size=count)], table[palette, rng.integers(8, size=count)]
        share = rng.beta(0.5, 0.5, (count, 1)).astype(np.float32)
        exposure = 0.9 * np.exp(rng.normal(0, 0.15, (count, 1))).astype(np.float32)
        return np.minimum((one + (other - one) * share) * exposure, 0.93)  # white keeps its grain

    return mixture(), mixture()


def make_noise_tile(rng: Generator, exponent: float = 1.0) -> Array:
    """Return periodic fractal noise of unit standard deviation with an amplitude of 1/f^exponent."""
    frequency = np.hypot(np.fft.fftfreq(TILE)[:, None], np.fft.rfftfreq(TILE)[None])
    frequency[0, 0] = np.inf
    noise = np.fft.irfft2(np.fft.rfft2(rng.standard_normal((TILE, TILE))) / frequency**exponent)
    return (noise / noise.std()).astype(np.float32)


def make_script_tile(rng: Generator) -> Array:
    """Return lines of invented writing, 1 on 0: strokes between points of a 3x3 grid, with gaps between words."""
    tile = np.zeros((TILE, TILE), np.uint8)
    corners = np.indices((TILE // GLYPH[1], TILE // GLYPH[0])).T.reshape(-1, 1, 1, 2) * [GLYPH[1], GLYPH[0]]
    strokes = corners + [3, 4] + [3, 4] * rng.integers(0, 3, (len(corners), 2, 3, 2))
    strokes = strokes[rng.random(len(corners)) > 0.15].reshape(-1, 3, 2).astype(np.int32)
    cv2.polylines(tile, list(strokes), isClosed=False, color=255, lineType=cv2.LINE_AA)
    return tile.astype(np.float32) / 255


def read_tile(tile: Array, x: Array, y: Array) -> Array:
    """Return values of a periodic tile, interpolated linearly at pixel positions."""
    side = 1024  # cv2.remap takes pictures of less than 32768 rows
    rows = -(-x.size // side)
    at = np.zeros((2, rows * side), np.float32)
    at[0, : x.size], at[1, : x.size] = x % TILE, y % TILE
    values = cv2.remap(
        tile, at[0].reshape(rows, side), at[1].reshape(rows, side), cv2.INTER_LINEAR, None, cv2.BORDER_WRAP
    )
    return values.ravel()[: x.size].astype(np.float32, copy=False)


def _wave(position: Array, period: Array) -> Array:
    """Return stripes between 0 and 1: a sine at fine periods, wider stripes with edges of about a pixel."""
    steepness = np.maximum(period / 5, 1)
    return (0.5 + 0.5 * steepness * np.sin(position * (2 * math.pi / period))).clip(0, 1)


def _period(style: Array, size: Array) -> Array:
    """Return a period from 4 pixels to about half a radius, uniform in its logarithm."""
    return 4 * np.maximum(size / 8, 1) ** style


def _plain(along: Array, across: Array, size: Array, style: Array, _tile: Array) -> Array:
    ramp = (style[0] - 0.5) * along + (style[1] - 0.5) * across
    return (0.5 + ramp / size).clip(0, 1)


def _stripes(along: Array, across: Array, size: Array, style: Array, _tile: Array) -> Array:
    bend = 0.3 * (style[2] - 0.5) * across**2 / size
    return _wave(along + bend + size * style[1], _period(style[0], size))


def _checks(along: Array, across: Array, size: Array, style: Array, _tile: Array) -> Array:
    period = 1.5 * _period(style[0], size)
    return (_wave(along, period) + _wave(across, period)) / 2


def _cloud(along: Array, across: Array, size: Array, style: Array, tile: Array) -> Array:
    zoom = np.maximum(4 * style[0], 1)
    value = read_tile(tile, along / zoom + TILE * style[1], across / zoom + TILE * style[2])
    return (0.5 + 0.45 * value).clip(0, 1)


def _veins(along: Array, across: Array, size: Array, style: Array, _tile: Array) -> Array:
    spacing = np.maximum(size * (0.15 + 0.15 * style[0]), 5)
    side_veins = _wave(along - 0.9 * np.abs(across), spacing) ** 3
    midrib = (1.5 - np.abs(across) / np.maximum(0.03 * size, 0.7)).clip(0, 1)
    return np.maximum(0.7 * side_veins, midrib)


def _script(along: Array, across: Array, _size: Array, style: Array, tile: Array) -> Array:
    zoom = 1 + 0.6 * style[0]  # small print, which little blur makes unreadable
    return read_tile(tile, along / zoom + TILE * style[1], across / zoom + TILE * style[2])


def _spots(along: Array, across: Array, size: Array, style: Array, _tile: Array) -> Array:
    period = 2 * _period(style[0], size)
    shifted = along + period / 2 * (np.floor(across / period) % 2)  # every second row is shifted by half a period
    off = np.hypot(shifted % period - period / 2, across % period - period / 2)
    return (period * (0.2 + 0.2 * style[1]) - off + 0.5).clip(0, 1)


def _rings(along: Array, across: Array, size: Array, style: Array, tile: Array) -> Array:
    wobble = 0.06 * size * read_tile(tile, along / 2 + TILE * style[1], across / 2 + TILE * style[2])
    off = np.hypot(along - 0.3 * size * (style[1] - 0.5), across - 0.3 * size * (style[2] - 0.5))
    return _wave(off + wobble, _period(style[0], size))


TEXTURES: tuple[Callable[[Array, Array, Array, Array, Array], Array], ...] = (
    _plain, _plain, _cloud, _cloud, _veins, _veins, _stripes, _checks, _script, _spots, _rings,
)  # fmt: skip
SCRIPT = TEXTURES.index(_script)  # writing is drawn into a separate tile
