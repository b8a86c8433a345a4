"""Restoration at the corner of a single element beside its centre, by the PSFs of the place and by those of the axis.

``python -m tests.benchmarks.restored_corner``; three minutes. The same scenes in both places: the middles of real ones
where they are on the machine, and painted ones. Decibels below the centre: the corner by the PSFs over the field and by
those of the axis; and by the PSFs of the place where each place is told the noise, of three, that restores it best: a
closed form that loses much more than this was told the wrong noise.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from kornia_tidy import Fidelity, FresnelLens, NoMask, SensorNoise, TiDyOptics
from kornia_tidy.data import photographic_leaves
from kornia_tidy.design.design_task import DesignTask, mask_of
from kornia_tidy.masks import CubicMask, PhaseMasks, PixelwiseMask, SpiralMask, initial_heights
from kornia_tidy.masks.base import mask_axes
from kornia_tidy.optics import ThinLensCamera
from kornia_tidy.reconstruction.camera_system import any_camera_system
from kornia_tidy.reconstruction.head_names import CLOSED_FORMS
from kornia_tidy.reconstruction.light_head import LightHead, reconstruct_light
from kornia_tidy.reconstruction.metrics import psnr
from kornia_tidy.reconstruction.pretrained import load_pretrained
from kornia_tidy.reconstruction.tasks import metres
from kornia_tidy.reconstruction.trained import load_camera
from tests.benchmarks.any_camera.scores import ELECTRONS, READ_ELECTRONS
from tests.benchmarks.results.scenes import real_scenes

PICTURE, PITCH = (1110, 1282), 8e-6
WINDOW = 65  # px of the PSFs
DEPTHS = (0.2975, math.inf)  # m: 20 rad on either side of focus at f/17.6
MARGIN = 16  # px at the edges that are not scored
NOISES = (1.0, 3.0, 10.0)  # times the sensor's, that closed forms may be told
ELEMENTS = ("chang2019", "sitzmann2018")  # published systems that are single elements
CASES = (
    "edof-5", "edof-5 f/25", "edof-designed", "spiral", "focal sweep", "smooth sweep", "smooth sweep f/25", "cubic",
    "fresnel", "none", "none f/25", "none f/48", *ELEMENTS
)  # fmt: skip


def camera_of(name: str) -> TiDyOptics:
    """Return a camera at the axis: published, saved, or the single element with masks, by "NAME f/NUMBER" (f/17.6).

    Masks are learnt, drawn by a seed, lenses of several powers, a cubic or a diffractive lens. A shipped system has its
    own f-number, if none is named, and focus; a smooth sweep focuses on all depths in turn.
    """
    fidelity = Fidelity(window=WINDOW, stray_light="veil")
    if name in ELEMENTS:
        return TiDyOptics.from_preset(name, lens="own", fidelity=fidelity, sensor=None, compositing="gather")
    if Path(name).is_file():
        saved = load_camera(name)
        assert saved is not None
        return TiDyOptics(saved.masks, saved.camera, saved.modulator, None, fidelity, lens=saved.lens)
    random = torch.Generator().manual_seed(3)
    kind, _, number = name.partition(" f/")
    f_number, focus = float(number or 17.6), 0.595
    if kind.startswith("edof"):
        own = load_pretrained(kind).optics
        assert isinstance(own.camera, ThinLensCamera)
        f_number, focus = float(number or own.camera.f_number), float(own.camera.focus_distance)
    task = DesignTask(lens="single-50mm", depth_range=DEPTHS, pixel_pitch=PITCH)
    given = f_number, DEPTHS[0] / focus  # inverse depth as a fraction of the range
    camera, lens = task.camera(*given), task.real_lens(*given)
    masks: PhaseMasks
    if kind.startswith("edof"):
        masks = own.masks
    elif kind == "focal sweep":
        masks = PixelwiseMask(initial=initial_heights(kind, random)[:5])
    else:
        masks = {
            "smooth sweep": lambda: _smooth_sweep(*camera.defocus_range),
            "spiral": lambda: SpiralMask(3, 46, generator=random),
            "cubic": lambda: CubicMask(20.0, 46),
            "fresnel": FresnelLens,
            "none": lambda: NoMask(23),
        }[kind]()
    return TiDyOptics(masks, camera, None, None, fidelity, lens=lens)


def _smooth_sweep(lo: float, hi: float) -> PixelwiseMask:
    y, x = mask_axes(92)
    return mask_of(-torch.linspace(lo, hi, 32)[:, None, None] * (x.square() + y.square()).float())


def scenes(side: int, count: int) -> list[tuple[str, Tensor, Tensor]]:
    """Return names, images (1, 3, side, side) encoded as sRGB, and normalised inverse depths (1, 1, side, side)."""
    found, real = [], real_scenes()
    photographed = (count + 1) // 2
    for name in real.half_a[:: max(1, len(real.half_a) // photographed)][:photographed]:
        scene = real.load(name)
        top, left = ((whole - side) // 2 for whole in scene.image.shape[-2:])
        if min(top, left) >= 0:
            parts = (scene.image, scene.inverse_depth)
            found.append((name, *(part[..., top : top + side, left : left + side] for part in parts)))
    for seed in range(count - len(found)):
        image, depth = photographic_leaves(side, side, depth_range=(1.0, float("inf")), seed=seed)
        found.append((f"painted {seed}", image[None], 1 / depth[None]))
    return found


class Place:
    """The camera at a place of the picture, and what restores its captures by the PSFs there and by the axis'."""

    def __init__(self, optics: TiDyOptics, center: tuple[float, float], head: str) -> None:
        self.optics = optics.with_fidelity(optics.fidelity)  # with the same parts
        self.optics.field_center, self.head = center, head

    def capture(self, image: Tensor, inverse_depth: Tensor) -> Tensor:
        """Return the noise-free light (1, 3, H, W) of a scene."""
        return self.optics.decode(self.optics(image, metres(self.optics.camera, inverse_depth)))

    def heads(self, sensor: SensorNoise) -> tuple[LightHead, LightHead]:
        """Return the restoration by the PSFs over the field, and by those of the axis."""
        by_place, by_axis = (LightHead(any_camera_system(self.optics, sensor, self.head)) for _ in range(2))
        by_axis.field = None
        return by_place, by_axis


def scores(head: LightHead, captures: Sequence[Tensor], images: Sequence[Tensor]) -> Tensor:
    """Return the PSNR of restored captures without their edges, (n,) decibels."""
    found, inner = [], (..., slice(MARGIN, -MARGIN), slice(MARGIN, -MARGIN))
    for light, image in zip(captures, images, strict=True):
        restored = reconstruct_light(head, light[0]).image
        assert restored is not None
        found.append(psnr(restored[None][inner], image[inner])[0])
    return torch.stack(found)


@torch.no_grad()
def losses(family: str, side: int, count: int, head: str) -> list[str]:
    """Return rows of the table for a camera, one for each number of electrons."""
    optics = camera_of(family)
    camera = optics.camera
    assert isinstance(camera, ThinLensCamera)
    corner = tuple((side - whole) / 2 for whole in PICTURE)
    if optics.lens is not None:  # within its field
        reach = optics.lens.field / camera.pixel_pitch - side / math.sqrt(2)
        corner = tuple(part * min(1.0, reach / math.hypot(*corner)) for part in corner)
    places = [Place(optics, center, head) for center in ((0.0, 0.0), corner)]
    own = scenes(side, count)
    lights = [[place.capture(image, near) for place in places] for _, image, near in own]
    images, rows = [image for _, image, _ in own], []
    for electrons in ELECTRONS:
        sensor = SensorNoise(READ_ELECTRONS / electrons, full_well=electrons)
        seen = [
            [sensor(light.clamp(0, 1), generator=torch.Generator().manual_seed(0)) for light in of_place]
            for of_place in zip(*lights, strict=True)
        ]
        told = [SensorNoise(n * READ_ELECTRONS / electrons, full_well=electrons / n**2) for n in NOISES]
        by_noise = [
            [scores(place.heads(noise)[0], light, images) for noise in told]
            for place, light in zip(places, seen, strict=True)
        ]
        best, best_there = (max(found, key=lambda own: float(own.mean())) for found in by_noise)
        centre, by_field = (found[0] for found in by_noise)
        lost = [centre - by_field, centre - scores(places[1].heads(sensor)[1], seen[1], images), best - best_there]
        cells = [f"{float(part.mean()):.2f} (worst {float(part.max()):.2f})" for part in lost]
        rows.append(f"| {family} | {electrons:,.0f} | {float(centre.mean()):.2f} | {' | '.join(cells)} |")
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.restored_corner", description=__doc__)
    parser.add_argument("--side", type=int, default=192, help="of the scenes in pixels (192)")
    parser.add_argument("--scenes", type=int, default=8, help="(8)")
    parser.add_argument("--head", choices=CLOSED_FORMS, default="wiener-bilateral", help="(wiener-bilateral)")
    parser.add_argument("--cameras", nargs="+", default=CASES, help=f"or files of saved ones ({', '.join(CASES)})")
    args = parser.parse_args(arguments)
    torch.set_num_threads(1)
    print("| camera | electrons | centre | corner, field | axis | corner, best noise |\n|---|---|---|---|---|---|")
    for family in args.cameras:
        print("\n".join(losses(family, args.side, args.scenes, args.head)), flush=True)


if __name__ == "__main__":
    main()
