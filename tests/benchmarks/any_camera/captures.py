"""Noise-free captures of painted scenes by the cameras of a pool, rendered once and stored in a folder."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb
from kornia.filters import gaussian_blur2d
from torch import Tensor
from torch.nn import functional

from kornia_tidy import TiDyOptics
from kornia_tidy.data import dead_leaves, photographic_leaves, read_image
from kornia_tidy.data.photo_collages import grain, photo_collage
from kornia_tidy.reconstruction.tasks import metres
from kornia_tidy.seeds import keyed_seed
from tests.benchmarks.any_camera.cameras import SHIPPED, camera, pool_names

SIDE = 192  # px of a scene
SCENES, SCENES_OF_SHIPPED = 32, 96
LEVELS = 2**16 - 1
STRIDE = 12  # between cameras whose captures are made one after the other, so that each kind comes early
LEAVES_OF_PICTURES = 0.4  # share of photographs with the depth of leaves
PICTURES = {"photographs": (40, 120), "more": (24, 60)}  # captures of whole ones by a camera, and by a shipped one
SOFT = 4  # of the latter every fourth is magnified
KINDS = ("leaves", "leaves", "leaves", "grain", "soft", "blank", "sharp")  # as often


class Captures(NamedTuple):
    """A camera's captures and their scenes in linear light, each (N, 3, H, W) uint16."""

    light: np.ndarray
    image: np.ndarray


def painted_scene(seed: int, side: int = SIDE) -> tuple[Tensor, Tensor]:
    """Return a painted scene of a kind drawn by the seed: sRGB (3, H, W), and normalised inverse depth (1, H, W).

    Beside leaves with the statistics of photographs there are such with grain, soft ones (out of a camera's focus),
    nearly blank ones, and sharp leaves of large contrast.
    """
    random = torch.Generator().manual_seed(seed)
    kind = KINDS[int(torch.randint(len(KINDS), (), generator=random))]
    place = float(torch.rand((), generator=random))
    paint = dead_leaves if kind == "sharp" else photographic_leaves
    image, depth = paint(side, side, depth_range=(1.0, float("inf")), seed=seed)
    if kind == "grain":
        image = image + torch.from_numpy(grain(side, side, np.random.default_rng(seed)))
    elif kind == "soft":
        sigma = 0.8 * 4**place
        light = gaussian_blur2d(rgb_to_linear_rgb(image[None]), (25, 25), (sigma, sigma), "replicate")
        image = linear_rgb_to_rgb(light)[0]
    elif kind == "blank":
        mean = image.mean((1, 2), keepdim=True)
        image = mean + (0.02 + 0.2 * place) * (image - mean)
    return image.clamp(0, 1), 1 / depth


@torch.no_grad()
def photographed(optics: TiDyOptics, image: Tensor, inverse_depth: Tensor) -> Tensor:
    """Return the noise-free capture in linear light, (3, H, W), of a scene stretched over the camera's depths."""
    capture = optics(image[None], metres(optics.camera, inverse_depth[None]))
    return optics.decode(capture)[0].clamp(0, 1)


def stored(folder: Path, name: str, scenes: int | None = None) -> Captures:
    """Return the captures of a camera, which are made if they are not in the folder."""
    count = scenes or (SCENES_OF_SHIPPED if name in SHIPPED else SCENES)
    _make(folder, name, name, (painted_scene(keyed_seed(f"{name} scenes", index)) for index in range(count)))
    light, image = (np.load(folder / f"{name}-{part}.npy", mmap_mode="r") for part in ("light", "image"))
    return Captures(light, image)


def photograph_collages(folder: Path, photographs: Sequence[str], scenes: int = 10) -> None:
    """Make captures of collages of photographs by the cameras of training; of the shipped ones more."""

    def collage(seed: int) -> tuple[Tensor, Tensor]:
        scene, depth = photo_collage(photographs, SIDE, SIDE, depth_range=(1.0, float("inf")), seed=seed)
        return scene, 1 / depth

    for name in pool_names("training"):
        count = 3 * scenes if name in SHIPPED else scenes
        own = (collage(keyed_seed(f"{name} collages", index)) for index in range(count))
        _make(folder, f"{name}-collages", name, own)


def photograph_pictures(folder: Path, photographs: Sequence[Path]) -> None:
    """Make captures of whole photographs by the cameras of training, those of shipped systems first; of these more."""

    def picture(kind: str, index: int, seed: int) -> tuple[Tensor, Tensor]:
        scene, near = pictured_scene(photographs, seed)
        return magnified(scene, seed) if kind == "more" and index % SOFT == SOFT - 1 else scene, near

    names = pool_names("training")
    ordered = [*SHIPPED, *(one for first in range(STRIDE) for one in names[len(SHIPPED) + first :: STRIDE])]
    for kind, (scenes, of_shipped) in PICTURES.items():
        for name in ordered:
            count = of_shipped if name in SHIPPED else scenes
            own = (picture(kind, index, keyed_seed(f"{name} {kind}", index)) for index in range(count))
            _make(folder, f"{name}-{kind}", name, own)
            print(name, kind, flush=True)


def magnified(image: Tensor, seed: int) -> Tensor:
    """Return a quarter of a picture at the size of the whole: soft, as a scene out of focus."""
    side = image.shape[-1] // 2
    first = seed % (image.shape[-1] - side)
    part = rgb_to_linear_rgb(image[None, :, first : first + side, first : first + side])
    return linear_rgb_to_rgb(functional.interpolate(part, image.shape[-2:], mode="bicubic").clamp(0, 1))[0]


def pictured_scene(photographs: Sequence[Path], seed: int, side: int = SIDE) -> tuple[Tensor, Tensor]:
    """Return a part of a photograph on a plane: sRGB (3, H, W), and its normalised inverse depth (1, H, W).

    The plane is tilted at random; in four of ten scenes it is the depth of painted leaves, which does not follow from
    the picture. A photograph is reduced in linear light to 1 to 1/3 of its sides, as its size allows.
    """
    rng = np.random.default_rng(seed)
    light = rgb_to_linear_rgb(read_image(photographs[rng.integers(len(photographs))])[None, :3])[0]
    largest = min(light.shape[-2:]) / side
    factor = min(3.0, largest) ** rng.random() if largest > 1 else largest
    size = [max(side, round(length / factor)) for length in light.shape[-2:]]
    reduced = cv2.resize(light.permute(1, 2, 0).numpy(), size[::-1], interpolation=cv2.INTER_AREA)
    top, left = (int(rng.integers(length - side + 1)) for length in size)
    part = torch.from_numpy(np.ascontiguousarray(reduced[top : top + side, left : left + side].transpose(2, 0, 1)))
    image = linear_rgb_to_rgb(part[None].clamp(0, 1))[0]
    if rng.random() < LEAVES_OF_PICTURES:
        return image, 1 / dead_leaves(side, side, depth_range=(1.0, float("inf")), seed=seed)[1]
    angle, (first, last) = 2 * np.pi * rng.random(), rng.random(2)
    down, across = np.mgrid[:side, :side] / side - 0.5
    place = 0.5 + (np.cos(angle) * down + np.sin(angle) * across) / np.sqrt(2)
    return image, torch.from_numpy((first + (last - first) * place)[None].astype(np.float32))


def _make(folder: Path, title: str, name: str, scenes: Iterable[tuple[Tensor, Tensor]]) -> None:
    """Write a camera's captures of scenes, and the scenes, in linear light; those in the folder are kept.

    A file is moved to its place once it is whole.
    """
    light, image = (folder / f"{title}-{part}.npy" for part in ("light", "image"))
    if light.exists():
        return
    optics, seen, shown = camera(name), [], []
    for scene, near in scenes:
        seen.append(photographed(optics, scene, near))
        shown.append(rgb_to_linear_rgb(scene[None])[0])
    folder.mkdir(parents=True, exist_ok=True)
    for path, part in ((image, shown), (light, seen)):
        values = (torch.stack(part) * LEVELS).round().numpy().astype(np.uint16)
        with open(partial := path.with_suffix(".partial"), "wb") as file:
            np.save(file, values)
        partial.rename(path)


def photograph(folder: Path, pool: str, scenes: int | None = None) -> None:
    """Make the captures of a whole pool."""
    for name in pool_names(pool):
        stored(folder, name, scenes)
        print(name, flush=True)
