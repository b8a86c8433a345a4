"""Restoration at the corner of a single element beside its centre, by the PSFs of the place and by those of the axis.

``python -m tests.benchmarks.restored_corner``; half an hour. The same scenes in both places: the middles of real ones
where they are on the machine, and painted ones. Decibels below the centre: the corner by the PSFs over the field and by
those of the axis; and what the lens costs the best linear filter, which least squares find with the truth of all scenes
at hand: a closed form that loses more than this has a fault of its own.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence

import torch
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb
from torch import Tensor
from torch.nn.functional import unfold

from kornia_tidy import Fidelity, FresnelLens, NoMask, SensorNoise, TiDyOptics
from kornia_tidy.data import photographic_leaves
from kornia_tidy.masks import CubicMask, PhaseMasks, PixelwiseMask, SpiralMask, initial_heights
from kornia_tidy.optics import Lens, ThinLensCamera
from kornia_tidy.reconstruction.camera_system import any_camera_system
from kornia_tidy.reconstruction.head_names import CLOSED_FORMS
from kornia_tidy.reconstruction.light_head import LightHead, reconstruct_light
from kornia_tidy.reconstruction.metrics import psnr
from kornia_tidy.reconstruction.pretrained import load_pretrained
from kornia_tidy.reconstruction.tasks import metres
from tests.benchmarks.any_camera.scores import ELECTRONS, READ_ELECTRONS
from tests.benchmarks.results.scenes import real_scenes

PICTURE, PITCH = (1110, 1282), 8e-6
WINDOW = 65  # px of the PSFs
DEFOCUS = 20.0  # rad, the most on either side of focus
MARGIN = 16  # px at the edges that are not scored
FILTER, TURNS = 25, 6  # px along a side of the best linear filter, and weighted turns to find it
ELEMENTS = ("chang2019", "sitzmann2018")  # published systems that are single elements
CASES = (
    "edof-5", "edof-designed", "spiral", "focal sweep", "cubic", "fresnel", "none", "none f/11", "none f/25", *ELEMENTS
)  # fmt: skip


def camera_of(name: str) -> TiDyOptics:
    """Return a camera at the axis: a published one, or the single element with masks at f/17.6 or without at another.

    Masks are learnt, drawn by a seed, lenses of several powers, a cubic or a diffractive lens.
    """
    fidelity = Fidelity(window=WINDOW, stray_light="veil")
    if name in ELEMENTS:
        return TiDyOptics.from_preset(name, lens="own", fidelity=fidelity, sensor=None, compositing="gather")
    random = torch.Generator().manual_seed(3)
    kind, _, number = name.partition(" f/")
    masks: PhaseMasks
    if kind.startswith("edof"):
        masks = load_pretrained(kind).optics.masks
    elif kind == "focal sweep":
        masks = PixelwiseMask(initial=initial_heights(kind, random)[:5])
    else:
        masks = {
            "spiral": lambda: SpiralMask(3, 46, generator=random),
            "cubic": lambda: CubicMask(20.0, 46),
            "fresnel": FresnelLens,
            "none": lambda: NoMask(23),
        }[kind]()
    lens = Lens.named("single-50mm", float(number or 17.6), 0.595)
    whole = lens.camera(PITCH)
    per_dioptre = math.pi * (whole.aperture_diameter / 2) ** 2 / 530e-9
    nearest, farthest = (1 / whole.focus_distance + sign * DEFOCUS / per_dioptre for sign in (1, -1))
    camera = lens.camera(PITCH, (1 / nearest, 1 / max(farthest, 1e-9)))
    return TiDyOptics(masks, camera, None, None, fidelity, lens=lens)


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


def best_filtered(seen: Sequence[Tensor], images: Sequence[Tensor]) -> list[Tensor]:
    r"""Return the inner parts of captures restored by the one filter of the best mean PSNR, a colour by its own.

    .. math:: \min_k \sum_n \log \sum_x g'(t_{nx})^2 \, \big( (k * y_n)_x - t_{nx} \big)^2

    with the curve g of sRGB, whose error is g' times that of linear light. By least squares, weighted by turns.

    Args:
        seen: linear light of each capture, (1, 3, H, W).
        images: the truth, encoded as sRGB.
    """
    inner = (..., slice(MARGIN, -MARGIN), slice(MARGIN, -MARGIN))
    reach = MARGIN - FILTER // 2
    around = [unfold(light[..., reach:-reach, reach:-reach].movedim(1, 0), FILTER) for light in seen]  # (3, n, pixels)
    squares, right, power = [], [], []
    for rows, image in zip(around, images, strict=True):
        truth = rgb_to_linear_rgb(image[inner])[0].flatten(1)[:, None, ::2]  # half of the pixels tell as much
        slope = torch.where(truth > 0.0031308, 1.055 / 2.4 * truth.clamp(min=1e-4) ** (1 / 2.4 - 1), 12.92)
        weighted, aim = rows[..., ::2] * slope, slope * truth
        squares.append((weighted @ weighted.mT).double())
        right.append((weighted @ aim.mT).double())
        power.append(aim.double().square().sum())
    whole, aims, share = torch.stack(squares), torch.stack(right), torch.ones(len(seen), 1, 1, 1).double()
    whole += 1e-7 * whole.diagonal(dim1=-2, dim2=-1).mean() * torch.eye(FILTER**2, dtype=torch.float64)
    kernels = aims[0]
    for _ in range(TURNS):
        kernels = torch.linalg.solve((share * whole).sum(0), (share * aims).sum(0))
        left = torch.stack(power) + (kernels.mT @ (whole @ kernels - 2 * aims)).sum((1, 2, 3))
        share = 1 / left[:, None, None, None]
    restored = [(kernels.mT.float() @ rows).view_as(image[inner]) for rows, image in zip(around, images, strict=True)]
    return [linear_rgb_to_rgb(part.clamp(0, 1)) for part in restored]


@torch.no_grad()
def losses(family: str, side: int, count: int, head: str) -> list[str]:
    """Return rows of the table for a camera, one for each number of electrons."""
    optics = camera_of(family)
    camera = optics.camera
    assert isinstance(camera, ThinLensCamera)
    corner = tuple((side - whole) / 2 for whole in PICTURE)
    if optics.lens is not None:  # within its field
        corner = tuple(part * min(1.0, optics.lens.field / camera.pixel_pitch / 870) for part in corner)
    places = [Place(optics, center, head) for center in ((0.0, 0.0), corner)]
    own = scenes(side, count)
    lights = [[place.capture(image, near) for place in places] for _, image, near in own]
    inner, rows = (..., slice(MARGIN, -MARGIN), slice(MARGIN, -MARGIN)), []
    for electrons in ELECTRONS:
        sensor = SensorNoise(READ_ELECTRONS / electrons, full_well=electrons)
        heads = [place.heads(sensor) for place in places]
        generators = [[torch.Generator().manual_seed(0) for _ in places] for _ in own]
        seen = [
            [sensor(light.clamp(0, 1), generator=one) for light, one in zip(*pair, strict=True)]
            for pair in zip(lights, generators, strict=True)
        ]
        images = [image for _, image, _ in own]
        best_of = [best_filtered([pair[i] for pair in seen], images) for i in (0, 1)]
        scored: list[list[float]] = []
        for n, (name, image, _) in enumerate(own):
            found = []
            for form, i in ((heads[0][0], 0), (heads[1][0], 1), (heads[1][1], 1)):
                restored = reconstruct_light(form, seen[n][i][0]).image
                assert restored is not None
                found.append(restored[None][inner])
            found += [best_of[0][n], best_of[1][n]]
            scored.append([float(psnr(part, image[inner])) for part in found])
            print(
                f"  {family}, {electrons:.0f} e-, {name}: {' '.join(f'{value:.2f}' for value in scored[-1])}",
                flush=True,
            )
        centre, by_field, by_axis, best, best_there = torch.tensor(scored).T
        lost = [centre - by_field, centre - by_axis, best - best_there, centre - by_field - best + best_there]
        cells = [f"{float(part.mean()):.2f} (worst {float(part.max()):.2f})" for part in lost]
        rows.append(f"| {family} | {electrons:,.0f} | {float(centre.mean()):.2f} | {' | '.join(cells)} |")
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.restored_corner", description=__doc__)
    parser.add_argument("--side", type=int, default=192, help="of the scenes in pixels (192)")
    parser.add_argument("--scenes", type=int, default=8, help="(8)")
    parser.add_argument("--head", choices=CLOSED_FORMS, default="wiener-bilateral", help="(wiener-bilateral)")
    parser.add_argument("--cameras", nargs="+", choices=CASES, default=CASES, help="(all)")
    args = parser.parse_args(arguments)
    torch.set_num_threads(1)
    print("| camera | electrons | centre | corner, field | axis | best linear filter | beyond it |")
    print("|---|---|---|---|---|---|---|")
    for family in args.cameras:
        print("\n".join(losses(family, args.side, args.scenes, args.head)), flush=True)


if __name__ == "__main__":
    main()
