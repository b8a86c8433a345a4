"""Paint the scene "table" that comes with the library: python docs/make_sample_scene.py.

Balls, books and boxes in sunlight on a table in front of a wall, 0.4 to 3.2 m away, into ``kornia_tidy/data/scenes``:
the image as sRGB of 8 bits, the depth in tenths of a millimetre. It is painted at twice the size and averaged in linear
light; depths are not mixed. Rays and their shadows are those of Whitted, An improved illumination model for shaded
display, Communications of the ACM 23 (1980).
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from kornia.color import linear_rgb_to_rgb
from numpy.typing import NDArray
from torch import Tensor

from kornia_tidy.arrays import to_opencv
from kornia_tidy.data.leaf_textures import make_noise_tile, make_script_tile, read_tile
from kornia_tidy.data.photographic_leaves import ZOOM, averaged, of_most
from kornia_tidy.data.sample_scenes import SCALE

Array = NDArray[np.float32]

FOLDER = Path(__file__).parents[1] / "kornia_tidy" / "data" / "scenes"
HEIGHT = 480  # pixels
FOCAL_LENGTH = 1.1  # of the painted view, in widths of the picture
PITCH = math.radians(14.0)  # the view looks down
TABLE, WALL, EDGE = 0.24, 3.2, 1.75  # m: below the eye, ahead of it, and where the table ends
SUN = (-0.62, -0.7, -0.36)  # towards the light: x to the right, y down, z ahead
SUN_SPREAD = 0.03  # rad; its half width, which softens shadows
SKY = 0.35  # light of the surroundings, relative to the sun's
WOOD, PLASTER = (0.32, 0.17, 0.08), (0.5, 0.52, 0.5)  # linear reflectances
PICTURES = ((-0.75, -0.2, -0.62, 0.1, (0.6, 0.35, 0.15)), (0.3, 0.95, -0.55, -0.1, (0.15, 0.3, 0.45)))
"""On the wall: left, right, upper and lower edge in metres, and reflectance."""


class Thing(NamedTuple):
    """A ball or a box on the table."""

    x: float
    """Metres from the middle, to the right."""
    z: float
    """Metres ahead."""
    half: tuple[float, float, float]
    """Half its width, height and length in metres; a ball has three equal ones."""
    yaw: float | None
    """Radians around the vertical; None: a ball."""
    colour: tuple[float, float, float]
    """Linear reflectance."""
    pattern: str
    above: float = 0.0
    """Metres between it and the table."""

    @property
    def centre(self) -> tuple[float, float, float]:
        """Of the thing, in metres from the eye."""
        return self.x, TABLE - self.above - self.half[1], self.z


THINGS = (
    Thing(-0.07, 0.40, (0.034, 0.034, 0.034), None, (0.80, 0.28, 0.03), "peel"),
    Thing(0.115, 0.50, (0.06, 0.018, 0.08), 0.5, (0.55, 0.06, 0.05), "print"),
    Thing(0.11, 0.50, (0.052, 0.012, 0.07), 0.2, (0.75, 0.7, 0.55), "print", 0.036),
    Thing(-0.20, 0.62, (0.05, 0.09, 0.03), -0.4, (0.08, 0.25, 0.5), "stripes"),
    Thing(0.02, 0.72, (0.045, 0.045, 0.045), None, (0.25, 0.5, 0.08), "peel"),
    Thing(0.30, 0.86, (0.07, 0.12, 0.05), 0.3, (0.75, 0.55, 0.2), "print"),
    Thing(-0.08, 1.02, (0.05, 0.14, 0.05), 0.75, (0.6, 0.58, 0.55), "checks"),
    Thing(-0.42, 1.12, (0.09, 0.09, 0.09), None, (0.5, 0.1, 0.16), "plain"),
    Thing(0.15, 1.35, (0.06, 0.06, 0.06), None, (0.75, 0.68, 0.1), "peel"),
    Thing(0.48, 1.5, (0.1, 0.2, 0.06), -0.3, (0.12, 0.3, 0.2), "stripes"),
)


def table(height: int, width: int) -> tuple[Tensor, Tensor]:
    """Return image and depth of the table."""
    rng = np.random.default_rng(3)
    rays = _rays(ZOOM * height, ZOOM * width)
    sun = np.array(SUN, np.float32)[:, None, None] + rng.normal(0, SUN_SPREAD, rays.shape).astype(np.float32)
    sun /= np.sqrt((sun**2).sum(0))
    tiles = make_noise_tile(rng), make_noise_tile(rng, 1.5), make_script_tile(rng)

    depth = TABLE / np.maximum(rays[1], 1e-6)
    owner = np.where(depth * rays[2] < EDGE, -1, -2)  # table, wall
    depth = np.where(owner == -1, depth, WALL / rays[2]).astype(np.float32)
    for number, thing in enumerate(THINGS):
        hit = _hit(thing, np.zeros((3, 1, 1), np.float32), rays)
        owner[hit < depth] = number
        depth = np.minimum(depth, hit)
    points = rays * depth
    lit = np.ones(depth.shape, np.float32)
    for thing in THINGS:
        lit[_hit(thing, points, sun) < np.inf] = 0
    lit = cv2.GaussianBlur(lit, (0, 0), ZOOM)  # of the random directions to the sun

    light = np.zeros((*depth.shape, 3), np.float32)
    for number in range(-2, len(THINGS)):
        seen = owner == number
        if number < 0:
            normal, colour = _room(number, points[:, seen], tiles)
        else:
            normal, colour = _surface(THINGS[number], points[:, seen], tiles)
        sunlight = (normal * sun[:, seen]).sum(0).clip(0) * lit[seen]
        light[seen] = colour * (sunlight + SKY * (0.75 - 0.25 * normal[1]))[:, None]
    image = torch.from_numpy(np.ascontiguousarray(averaged(light).transpose(2, 0, 1)))
    encoded = linear_rgb_to_rgb(image.clamp(0, 1)[None])[0].clamp(0, 1)
    return encoded, torch.from_numpy((1 / of_most(1 / depth)).astype(np.float32)[None])


def _rays(height: int, width: int) -> Array:
    """Return the directions in which the pixels look, (3, H, W), of length one along the optical axis."""
    y, x = np.mgrid[:height, :width].astype(np.float32)
    x, y = ((place + 0.5 - side / 2) / (FOCAL_LENGTH * width) for place, side in ((x, width), (y, height)))
    return np.stack([x, y * math.cos(PITCH) + math.sin(PITCH), math.cos(PITCH) - y * math.sin(PITCH)])


def _of_thing(thing: Thing, vectors: Array) -> Array:
    """Return vectors along a thing's axes, (3, ...)."""
    yaw = thing.yaw or 0.0
    x, y, z = vectors
    return np.stack([math.cos(yaw) * x - math.sin(yaw) * z, y, math.sin(yaw) * x + math.cos(yaw) * z])


def _hit(thing: Thing, start: Array, rays: Array) -> Array:
    """Return how far along each ray a thing is, in lengths of the ray; inf where it is missed or left behind.

    Args:
        thing: ball or box.
        start: where the rays begin, (3, ...).
        rays: their directions, (3, ...).
    """
    begin = start - np.array(thing.centre, np.float32)[:, None, None]
    if thing.yaw is None:
        square, half = (rays**2).sum(0), (begin * rays).sum(0)
        root = half**2 - square * ((begin**2).sum(0) - thing.half[0] ** 2)
        first = (-half - np.sqrt(root.clip(0))) / square
        met = root > 0
    else:
        half = np.array(thing.half, np.float32)[:, None, None]
        along, begin = _of_thing(thing, rays), _of_thing(thing, begin)
        along = np.where(np.abs(along) < 1e-9, np.float32(1e-9), along)
        middle, reach = -begin / along, half / np.abs(along)
        first, last = (middle - reach).max(0), (middle + reach).min(0)
        met = first < last
    return np.where(met & (first > 1e-4), first, np.inf).astype(np.float32)


def _room(number: int, points: Array, tiles: tuple[Array, Array, Array]) -> tuple[Array, Array]:
    """Return normals (3, N) and colours (N, 3) of the table, -1, or the wall, -2."""
    noise, cloud, _ = tiles
    x, y, z = points
    if number == -1:
        plank = np.floor(x / 0.11)
        grain = 0.22 * read_tile(cloud, 5000 * x + 131 * plank, 180 * z + 57 * plank)
        grain += 0.12 * read_tile(noise, 2500 * x, 90 * z) + 0.12 * np.sin(7.1 * plank)
        seam = np.where(np.abs(x / 0.11 - plank - 0.5) > 0.487, -0.7, 0.0)
        return np.array([[0.0], [-1.0], [0.0]], np.float32), np.exp(grain + seam)[:, None] * np.array(WOOD)
    tone = 0.06 * read_tile(cloud, 250 * x, 250 * y) + 0.04 * read_tile(noise, 150 * x, 150 * y)
    colour = np.exp(tone + 0.25 * x - 0.5 * y.clip(0))[:, None] * np.array(PLASTER)
    for left, right, top, bottom, paint in PICTURES:
        inside = np.minimum(np.minimum(x - left, right - x), np.minimum(y - top, bottom - y))  # m from the edge
        canvas = np.exp(0.8 * read_tile(cloud, 220 * x, 260 * y))[:, None] * np.array(paint)
        colour = np.where((inside > 0)[:, None], canvas, colour)
        colour[(inside > 0) & (inside < 0.03)] = 0.05  # its frame
    return np.array([[0.0], [0.0], [-1.0]], np.float32), colour


def _surface(thing: Thing, points: Array, tiles: tuple[Array, Array, Array]) -> tuple[Array, Array]:
    """Return normals (3, N) and colours (N, 3) of a thing."""
    noise, cloud, script = tiles
    place = _of_thing(thing, points - np.array(thing.centre, np.float32)[:, None])
    if thing.yaw is None:
        normal = place / thing.half[0]
        u = thing.half[0] * np.arctan2(normal[0], -normal[2])
        v = thing.half[0] * np.arctan2(normal[1], np.hypot(normal[0], normal[2]))
    else:
        face = np.abs(place / np.array(thing.half, np.float32)[:, None]).argmax(0)
        x, y, z = np.sign(place) * (face == np.arange(3)[:, None])
        cos, sin = math.cos(thing.yaw), math.sin(thing.yaw)
        normal = np.stack([cos * x + sin * z, y, cos * z - sin * x])
        u, v = np.where(face == 0, place[2], place[0]), np.where(face == 1, place[2], place[1])
    tone = 0.08 * read_tile(cloud, 2000 * u + 300 * thing.x, 2000 * v)
    colour = np.exp(tone)[:, None] * np.array(thing.colour)
    if thing.pattern == "peel":
        colour *= np.exp(0.1 * read_tile(noise, 6000 * u, 6000 * v))[:, None]
    elif thing.pattern == "print":
        ink = read_tile(script, 4000 * u, 4000 * v) * (np.abs(u) < 0.75 * thing.half[0])
        colour *= (1 - 0.85 * ink)[:, None]
    elif thing.pattern == "stripes":
        colour[np.sin(300 * v) < 0.3] = 0.4
    elif thing.pattern == "checks":
        colour[np.sin(200 * u) * np.sin(200 * v) < 0] *= 0.3
    return normal.astype(np.float32), colour.astype(np.float32)


if __name__ == "__main__":
    image, depth = table(HEIGHT, HEIGHT * 4 // 3)
    pixels, tenths = to_opencv(image), np.rint(depth[0].numpy() / SCALE).astype(np.uint16)
    for name, stored in (("table.png", pixels), ("table_depth.png", tenths)):
        cv2.imwrite(str(FOLDER / name), stored, [cv2.IMWRITE_PNG_COMPRESSION, 9])
