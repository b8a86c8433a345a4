"""Restoration at the corner of a single element beside its centre, by the PSFs of the place and by those of the axis.

``python -m tests.benchmarks.restored_corner``; some minutes. The same scenes in both places: the middles of real ones
where they are on the machine, and painted ones. Decibels below the centre: the corner by the PSFs over the field and by
those of the axis; the same for the scene moved to where the lens's curved field is in focus, since a flat scene is out
of focus in the corner; and the centre in the corner's light, which tells the part of relative illumination.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from kornia_tidy import Fidelity, NoMask, SensorNoise, TiDyOptics
from kornia_tidy.data import photographic_leaves
from kornia_tidy.masks import PhaseMasks, PixelwiseMask, SpiralMask, initial_heights
from kornia_tidy.optics import Lens
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
PAINTED = 4
MOVED = 4.0  # rad, at the near end of the camera's range that scenes leave free
MARGIN = 16  # px at the edges that are not scored


def masks_of(name: str) -> PhaseMasks:
    """Return masks of a family: learnt ones, ones drawn by a seed, lenses of several powers, or none."""
    random = torch.Generator().manual_seed(3)
    if name == "edof-5":
        return load_pretrained(name).optics.masks
    if name == "spiral":
        return SpiralMask(3, 46, generator=random)
    return NoMask(23) if name == "none" else PixelwiseMask(initial=initial_heights(name, random)[:5])


def scenes(side: int, count: int) -> list[tuple[str, Tensor, Tensor]]:
    """Return names, images (1, 3, side, side) encoded as sRGB, and normalised inverse depths (1, 1, side, side)."""
    found, real = [], real_scenes()
    for name in real.half_a[:: max(1, len(real.half_a) // max(1, count - PAINTED))][: count - PAINTED]:
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

    def __init__(self, lens: Lens, masks: PhaseMasks, center: tuple[float, float], head: str) -> None:
        fidelity = Fidelity(window=WINDOW, stray_light="veil")
        self.optics = TiDyOptics(masks, lens.camera(PITCH), None, None, fidelity, lens=lens, field_center=center)
        self.head = head

    def capture(self, image: Tensor, inverse_depth: Tensor, nearer: float = 0.0) -> Tensor:
        """Return the noise-free light (1, 3, H, W) of a scene, moved nearer by a defocus in radians."""
        camera = self.optics.camera
        low, high = camera.defocus_range
        psi = low + (high - low - MOVED) * inverse_depth + nearer  # not beyond the range, moved or not
        return self.optics.decode(self.optics(image, metres(camera, (psi - low) / (high - low))))

    def heads(self, sensor: SensorNoise) -> tuple[LightHead, LightHead]:
        """Return the restoration by the PSFs over the field, and by those of the axis."""
        by_place, by_axis = (LightHead(any_camera_system(self.optics, sensor, self.head)) for _ in range(2))
        by_axis.field = None
        return by_place, by_axis


@torch.no_grad()
def losses(family: str, side: int, count: int, head: str) -> list[str]:
    """Return rows of the table for a family of masks, one for each number of electrons."""
    lens, masks = Lens.named("single-50mm", 17.6, 0.595), masks_of(family)
    corner = tuple((side - whole) / 2 for whole in PICTURE)
    middle, beside = (Place(lens, masks, center, head) for center in ((0.0, 0.0), corner))
    height = PITCH * float(torch.tensor(corner).norm())
    sampled = lens.sample(torch.tensor([0.0, height]), torch.zeros(1), 530e-9).wavefront[:, 0, 2]
    curved = -2 * math.sqrt(3) * float(sampled[1] - sampled[0])  # the fourth of Noll's polynomials, as rho^2
    share = float(lens.relative_illumination(torch.tensor([height])))
    own = scenes(side, count)
    lights = [
        (name, image, middle.capture(image, near), *(beside.capture(image, near, psi) for psi in (0.0, curved)))
        for name, image, near in own
    ]
    rows = []
    for electrons in ELECTRONS:
        sensor = SensorNoise(READ_ELECTRONS / electrons, full_well=electrons)
        dim = SensorNoise(READ_ELECTRONS / (share * electrons), full_well=share * electrons)
        (by_middle, _), (by_field, by_axis), (in_dim_light, _) = (
            place.heads(noise) for place, noise in ((middle, sensor), (beside, sensor), (middle, dim))
        )
        lost: list[list[float]] = []
        for name, image, light, there, moved in lights:

            def score(head: LightHead, light: Tensor, noise: SensorNoise, image: Tensor = image) -> float:
                seen = noise(light.clamp(0, 1), generator=torch.Generator().manual_seed(0))
                restored = reconstruct_light(head, seen[0]).image
                assert restored is not None
                inner = (..., slice(MARGIN, -MARGIN), slice(MARGIN, -MARGIN))
                return float(psnr(restored[None][inner], image[inner]))

            best = score(by_middle, light, sensor)
            others = [(head, seen, sensor) for seen in (there, moved) for head in (by_field, by_axis)]
            others.append((in_dim_light, light, dim))
            lost.append([best, *(best - score(*given) for given in others)])
            words = " ".join(f"{value:.2f}" for value in lost[-1])
            print(f"  {family}, {electrons:.0f} e-, {name}: {words}", flush=True)
        each = torch.tensor(lost)
        mean, worst = each.mean(0).tolist(), each.amax(0).tolist()
        cells = [f"{mean[i]:.2f} (worst {worst[i]:.2f})" for i in range(1, 6)]
        rows.append(f"| {family} | {electrons:,.0f} | {mean[0]:.2f} dB | {' | '.join(cells)} |")
    return rows


def main(arguments: Sequence[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.restored_corner", description=__doc__)
    parser.add_argument("--side", type=int, default=192, help="of the scenes in pixels (192)")
    parser.add_argument("--scenes", type=int, default=8, help="(8)")
    parser.add_argument("--head", choices=CLOSED_FORMS, default="wiener-bilateral", help="(wiener-bilateral)")
    parser.add_argument("--masks", nargs="+", default=["edof-5", "spiral", "focal sweep", "none"])
    args = parser.parse_args(arguments)
    torch.set_num_threads(1)
    rows = [row for family in args.masks for row in losses(family, args.side, args.scenes, args.head)]
    print("| masks | electrons | centre | corner, field | axis | moved, field | axis | centre in the corner's light |")
    print("|---|---|---|---|---|---|---|---|")
    print("\n".join(rows))


if __name__ == "__main__":
    main()
