"""What captures lose that are not as the camera should take them, restored by the network for any camera."""

from __future__ import annotations

import json
from pathlib import Path

import torch
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb
from torch import Tensor

from kornia_tidy import NoMask, PixelwiseMask, SensorNoise, TiDyOptics
from kornia_tidy.files import write_bytes
from kornia_tidy.reconstruction.camera_system import any_camera_system
from kornia_tidy.reconstruction.clipped_light import CLIPPED
from kornia_tidy.reconstruction.light_head import LightHead, reconstruct_light
from kornia_tidy.reconstruction.pretrained import load_pretrained
from kornia_tidy.reconstruction.tasks import metres
from kornia_tidy.reconstruction.trained import TrainedSystem
from tests.benchmarks.any_camera.cameras import camera, pool_names
from tests.benchmarks.any_camera.scores import READ_ELECTRONS, scored_scenes
from tests.benchmarks.any_camera.training import TEACHERS, compressed, demosaiced, shifted
from tests.benchmarks.results.scenes import BenchScene

ELECTRONS = 57_000.0
SHIFT = 0.04  # radii of the pupil, 2 % of its diameter
UNCLIPPED = "four times overexposed, unclipped"


def with_hot_pixels(light: Tensor, share: float = 1e-3) -> Tensor:
    """Return a capture in which a share of the values is at full scale or zero, half each."""
    drawn = torch.rand(light.shape, generator=torch.Generator().manual_seed(1))
    return torch.where(drawn < share / 2, 1.0, torch.where(drawn < share, 0.0, light))


@torch.no_grad()
def measure(folder: Path) -> None:
    """Measure the loss of each disturbance behind shipped cameras and those of the test pool, and write it.

    In decibels beside the undisturbed capture; cameras that were measured before are not measured again.
    """
    scenes = scored_scenes("test")
    names = [*TEACHERS, *pool_names("test")]
    for name in names:
        if not (path := folder / f"guards-{name}.json").exists():
            rows = [_scores(name, scene) for scene in scenes]
            write_bytes(path, json.dumps(rows, indent=1).encode())
        _print(name, [json.loads(path.read_text())])
    for title, group in ("shipped cameras", TEACHERS), ("all", names):
        _print(title, [json.loads((folder / f"guards-{name}.json").read_text()) for name in group])


def _scores(name: str, scene: BenchScene) -> dict[str, dict[str, float]]:
    """Return the PSNR of each capture by each network: for any camera, and the camera's own if it has one."""
    optics = camera(name)
    sensor = SensorNoise(READ_ELECTRONS / ELECTRONS, full_well=ELECTRONS)
    systems = {"any-camera": any_camera_system(optics, sensor)}
    if name in TEACHERS:
        systems["own"] = load_pretrained(name)
    moved = optics
    if not isinstance(optics.masks, NoMask):
        heights = PixelwiseMask(initial=shifted(optics.masks.heights(), SHIFT, 0.0))
        moved = TiDyOptics(heights, optics.camera, fidelity=optics.fidelity, sensor=None)
    depth, truth = metres(optics.camera, scene.inverse_depth), rgb_to_linear_rgb(scene.image)
    light, off = (one.decode(one(scene.image, depth)).clamp(0, 1) for one in (optics, moved))
    seen, beside, over = (sensor(part, generator=torch.Generator().manual_seed(0)) for part in (light, off, 4 * light))
    wide = SensorNoise(sensor.sigma, full_well=ELECTRONS, clip=False)
    unclipped = wide(4 * light, generator=torch.Generator().manual_seed(0))
    hot, jpeg = with_hot_pixels(seen), compressed(seen, 92)
    known = (over < CLIPPED).all(1, keepdim=True)

    def score(system: TrainedSystem, capture: Tensor, noise: Tensor | None, gain: float = 1.0) -> float:
        if noise is None:  # as reconstruct takes it
            image = reconstruct_light(LightHead(system), capture[0]).image
            assert image is not None
        else:
            image = system.head(linear_rgb_to_rgb(capture.clamp(min=0)), noise=noise).clamp(0, 1)
        error = (image - linear_rgb_to_rgb((gain * truth).clamp(0, 1))).square()
        where = torch.ones_like(error) if gain == 1 else known.expand_as(error).float()
        return float(-10 * ((error * where).sum() / where.sum()).log10())  # NaN where the whole scene is clipped

    return {
        key: {
            "undisturbed": score(system, seen, sensor.std(seen)),
            "undisturbed, checked": score(system, seen, None),
            "hot": score(system, hot, sensor.std(hot)),
            "hot, checked": score(system, hot, None),
            "shifted": score(system, beside, sensor.std(beside)),
            "JPEG 92": score(system, jpeg, sensor.std(jpeg)),
            "JPEG 92, checked": score(system, jpeg, None),
            "demosaiced": score(system, demosaiced(seen), sensor.std(seen)),
            "four times overexposed": score(system, over, None, 4.0),
            UNCLIPPED: score(system, unclipped.clamp(max=8), wide.std(unclipped), 4.0),
        }
        for key, system in systems.items()
    }


def _print(title: str, cameras: list[list[dict[str, dict[str, float]]]]) -> None:
    """Print mean and worst loss behind cameras, each a list of scenes."""
    for key in ("any-camera", "own"):
        rows = [row[key] for scenes in cameras for row in scenes if key in row]
        for kind in rows[0] if rows else ():
            beside = UNCLIPPED if "overexposed" in kind else "undisturbed"
            lost = torch.tensor([row[kind] - row[beside] for row in rows])
            lost = lost[lost.isfinite()]
            found = torch.tensor([row[kind] for row in rows])
            print(f"{title}, {key}, {kind}: {float(found[found.isfinite()].mean()):.2f} dB, ", end="")
            print(f"{float(lost.mean()):+.2f}, worst {float(lost.min()):+.2f}", flush=True)
