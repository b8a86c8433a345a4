"""What captures lose that are not as the camera should take them, restored by the network for any camera."""

from __future__ import annotations

import json
from pathlib import Path

import torch
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb
from torch import Tensor

from kornia_tidy import PixelwiseMask, SensorNoise, TiDyOptics
from kornia_tidy.files import write_bytes
from kornia_tidy.reconstruction.camera_system import any_camera_system
from kornia_tidy.reconstruction.capture_checks import check_capture
from kornia_tidy.reconstruction.clipped_light import CLIPPED
from kornia_tidy.reconstruction.light_head import LightHead, reconstruct_light
from kornia_tidy.reconstruction.pretrained import load_pretrained
from kornia_tidy.reconstruction.tasks import metres
from tests.benchmarks.any_camera.cameras import camera
from tests.benchmarks.any_camera.scores import READ_ELECTRONS, scored_scenes
from tests.benchmarks.any_camera.training import compressed, demosaiced, shifted

CAMERA, ELECTRONS = "edof-designed", 57_000.0
SHIFT = 0.04  # radii of the pupil, 2 % of its diameter


def with_hot_pixels(light: Tensor, share: float = 1e-3) -> Tensor:
    """Return a capture in which a share of the values is at full scale or zero, half each."""
    drawn = torch.rand(light.shape, generator=torch.Generator().manual_seed(1))
    return torch.where(drawn < share / 2, 1.0, torch.where(drawn < share, 0.0, light))


@torch.no_grad()
def measure(folder: Path) -> None:
    """Measure the loss of each disturbance, in decibels beside the undisturbed capture, and write it."""
    optics = camera(CAMERA)
    sensor = SensorNoise(READ_ELECTRONS / ELECTRONS, full_well=ELECTRONS)
    systems = {"any-camera": any_camera_system(optics, sensor), "own": load_pretrained(CAMERA)}
    moved = TiDyOptics(
        PixelwiseMask(initial=shifted(optics.masks.heights(), SHIFT, 0.0)),
        optics.camera,
        fidelity=optics.fidelity,
        sensor=None,
    )
    rows = []
    for scene in scored_scenes("test"):
        depth = metres(optics.camera, scene.inverse_depth)
        truth = rgb_to_linear_rgb(scene.image)
        light, off = (one.decode(one(scene.image, depth)).clamp(0, 1) for one in (optics, moved))
        seen, beside = (sensor(part, generator=torch.Generator().manual_seed(0)) for part in (light, off))
        hot, jpeg = with_hot_pixels(seen), compressed(seen, 92)
        over = sensor(4 * light, generator=torch.Generator().manual_seed(0))
        wide = SensorNoise(sensor.sigma, full_well=ELECTRONS, clip=False)
        unclipped = wide(4 * light, generator=torch.Generator().manual_seed(0))
        known = (over < CLIPPED).all(1, keepdim=True)
        row: dict[str, object] = {"scene": scene.name}
        for name, system in systems.items():

            def score(capture: Tensor, noise: Tensor | None, mask: Tensor | None = None, gain: float = 1.0) -> float:
                if noise is None:  # as it is found
                    image = reconstruct_light(LightHead(system), capture[0]).image[None]  # noqa: B023
                else:
                    image = system.head(linear_rgb_to_rgb(capture.clamp(min=0)), noise=noise).clamp(0, 1)  # noqa: B023
                error = (image - linear_rgb_to_rgb((gain * truth).clamp(0, 1))).square()  # noqa: B023
                where = torch.ones_like(error) if mask is None else mask.expand_as(error).float()
                # NaN where the whole scene is clipped
                return float(-10 * ((error * where).sum() / where.sum()).log10())

            row[name] = {
                "undisturbed": score(seen, sensor.std(seen)),
                "undisturbed, checked": score(check_capture(seen[0]).light[None], sensor.std(seen)),
                "hot": score(hot, sensor.std(hot)),
                "hot, checked": score(check_capture(hot[0]).light[None], sensor.std(seen)),
                "shifted": score(beside, sensor.std(beside)),
                "JPEG 92": score(jpeg, sensor.std(jpeg)),
                "JPEG 92, checked": score(jpeg, None),
                "demosaiced": score(demosaiced(seen), sensor.std(seen)),
                "four times overexposed": score(over, sensor.std(over), known, 4.0),
                "four times overexposed, unclipped": score(unclipped.clamp(max=8), wide.std(unclipped), known, 4.0),
            }
        rows.append(row)
        print(scene.name, flush=True)
    write_bytes(folder / "guards.json", json.dumps(rows, indent=1).encode())
    for name in systems:
        for key in rows[0][name]:  # ty: ignore[not-iterable]
            each = torch.tensor([row[name][key] for row in rows])  # ty: ignore[not-subscriptable]
            beside = "four times overexposed, unclipped" if "overexposed" in key else "undisturbed"
            lost = each - torch.tensor([row[name][beside] for row in rows])  # ty: ignore[not-subscriptable]
            print(f"{name}, {key}: {float(each.nanmean()):.2f} dB, {float(lost.nanmean()):+.2f}")
