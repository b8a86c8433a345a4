"""Scores of the network behind the cameras of a pool, on real scenes: half A for choices, half B for the record."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from kornia.color import linear_rgb_to_rgb
from torch import Tensor

from kornia_tidy import SensorNoise
from kornia_tidy.files import write_bytes
from kornia_tidy.reconstruction import RuledClosedForm
from kornia_tidy.reconstruction.any_camera import (
    AnyCameraHead,
    any_camera_head,
    beside_clipped,
    corrected,
    largest_share,
)
from kornia_tidy.reconstruction.bilateral import bilateral_filter
from kornia_tidy.reconstruction.kernel_convolution import convolve_kernels
from kornia_tidy.reconstruction.metrics import psnr
from kornia_tidy.reconstruction.tasks import metres
from kornia_tidy.reconstruction.tikhonov_kernels import tikhonov_kernels
from kornia_tidy.reconstruction.trained import closed_form_bank
from kornia_tidy.reconstruction.wiener_kernels import wiener_kernels
from tests.benchmarks.any_camera.cameras import SHIPPED, camera, in_words, own_system, pool_names
from tests.benchmarks.results.scenes import BenchScene, real_scenes

SIDE = 256  # px, the middle of a scene
EVERY = 3  # scenes of a half
ELECTRONS = (2000.0, 57_000.0)  # of white, in the pixel of the camera
READ_ELECTRONS = 2.4
FACTORS = (-0.75, -0.375, 0.0, 0.375, 0.75)  # of the noise that Wiener's filter takes, as a logarithm
WEIGHTS = (3e-4, 3e-3, 1e-2, 3e-2)
COLORS = (0.0, 0.05, 0.1, 0.2, 0.4)


def scored_scenes(pool: str) -> list[BenchScene]:
    """Return the scenes of a pool, their middles."""
    scenes = real_scenes()
    names = (scenes.half_b if pool == "test" else scenes.half_a)[::EVERY]
    return [_middle(scenes.load(name)) for name in names]


def _middle(scene: BenchScene) -> BenchScene:
    height, width = scene.image.shape[-2:]
    rows, columns = min(SIDE, height), min(SIDE, width)
    top, left = (height - rows) // 2, (width - columns) // 2
    parts = (part[..., top : top + rows, left : left + columns] for part in scene[1:])
    return BenchScene(scene.name, *parts)


def scored_cameras(pool: str) -> list[str]:
    """Return the cameras of a pool; beside those for choices also the shipped ones."""
    return [*pool_names(pool), *SHIPPED] if pool != "training" else []


class Capturing:
    """A camera with its closed forms, and its captures of scenes."""

    def __init__(self, name: str) -> None:
        self.optics = camera(name)
        self.form = RuledClosedForm(7)
        self.form.set_psfs(closed_form_bank(self.optics, self.form.layers))

    def captures(self, scenes: list[BenchScene]) -> Iterator[tuple[BenchScene, float, Tensor, Tensor]]:
        """Return scene, electrons, capture in linear light, and its noise."""
        for scene in scenes:
            seen = self.optics(scene.image, metres(self.optics.camera, scene.inverse_depth))
            light = self.optics.decode(seen).clamp(0, 1)
            for electrons in ELECTRONS:
                sensor = SensorNoise(READ_ELECTRONS / electrons, full_well=electrons)
                noisy = sensor(light, generator=torch.Generator().manual_seed(0))
                yield scene, electrons, noisy, sensor.std(noisy)


@torch.no_grad()
def score_closed_forms(name: str, scenes: list[BenchScene]) -> Any:
    """Return the PSNR of closed forms for every choice of settings, capture by capture."""
    own, found = Capturing(name), []
    bank = closed_form_bank(own.optics)
    for scene, electrons, light, noise in own.captures(scenes):
        even = light - _stray(own.form, light)
        level = float(noise.square().mean().sqrt())
        choices = _closed_forms(bank.psfs, even, level, scene.image)
        scores = {"capture": float(psnr(linear_rgb_to_rgb(light), scene.image)), "choices": choices}
        found.append({"scene": scene.name, "electrons": electrons, **scores})
    return {"camera": in_words(own.optics), "scores": found}


@torch.no_grad()
def score_networks(name: str, scenes: list[BenchScene], networks: Mapping[str, torch.nn.Module]) -> Any:
    """Return the PSNR of the rule and of networks capture by capture; behind a shipped camera also of its own."""
    own, found = Capturing(name), []
    head = own_system(name).head if name in SHIPPED else None
    for scene, electrons, light, noise in own.captures(scenes):
        capture = linear_rgb_to_rgb(light)
        chosen = own.form.settings_of(capture, noise)
        restored = own.form.restore_by(capture, chosen)
        largest = beside_clipped(largest_share(own.form, chosen), capture)
        images = {"rule": restored.image}
        images |= {key: corrected(restored.image, net(restored.maps), largest) for key, net in networks.items()}
        if head is not None:
            images["own"] = head(capture, noise=noise)
        scores = {key: float(psnr(image.clamp(0, 1), scene.image)) for key, image in images.items()}
        found.append({"scene": scene.name, "electrons": electrons, **scores})
    return found


def _stray(form: RuledClosedForm, light: Tensor) -> Tensor:
    energy = form.psfs.mean(0).sum((-2, -1))
    return (form.veil / (energy + form.veil))[:, None, None] * light.mean((-2, -1), keepdim=True)


def _closed_forms(psfs: Tensor, light: Tensor, noise: float, truth: Tensor) -> list[float]:
    """Return the PSNR by every choice of form, weight and colour."""
    kernels = wiener_kernels(psfs, tuple(noise * 10**factor for factor in FACTORS))
    estimates = convolve_kernels(light, torch.cat([kernels, tikhonov_kernels(psfs.mean(0), WEIGHTS)]))
    found = []
    for estimate in estimates.unbind(1):
        image = linear_rgb_to_rgb(estimate.clamp(0, 1))
        found += [float(psnr(bilateral_filter(image, color) if color else image, truth)) for color in COLORS]
    return found


def networks_of(folder: Path, candidates: bool) -> dict[str, torch.nn.Module]:
    """Return the network that is shipped, and with candidates the mean of the weights, alone and with the first."""
    networks: dict[str, torch.nn.Module] = {"any-camera": any_camera_head().network.eval()}
    if candidates:
        first, weights = first_weights(folder), averaged(folder)
        networks |= {f"{share:g} of the first": _network(mixed(weights, first, share)) for share in (0.0, 0.35)}
    return networks


def first_weights(folder: Path) -> dict[str, Tensor]:
    """Return the weights from which training in a folder begins: its ``first.pt``, or those of a shipped network."""
    stored = folder / "first.pt"
    return torch.load(stored, weights_only=True) if stored.exists() else any_camera_head().network.state_dict()


def averaged(folder: Path) -> dict[str, Tensor]:
    """Return the mean of the weights at the checkpoint."""
    state = torch.load(folder / "checkpoint.pt", weights_only=True)["average"]
    return {name.removeprefix("network."): part for name, part in state.items() if name.startswith("network.")}


def mixed(one: Mapping[str, Tensor], other: Mapping[str, Tensor], share: float) -> dict[str, Tensor]:
    """Return weights between two of one descent."""
    return {name: (1 - share) * value + share * other[name] for name, value in one.items()}


def _network(weights: Mapping[str, Tensor]) -> torch.nn.Module:
    network = AnyCameraHead().network.eval()
    network.load_state_dict(weights)
    return network


def score_pool(folder: Path, pool: str, *, closed_forms: bool = False) -> None:
    """Score all cameras of a pool; what is in the folder is kept. Closed forms come first and alone."""
    scenes = scored_scenes(pool)
    networks = {} if closed_forms else networks_of(folder, candidates=pool == "validation")
    for name in scored_cameras(pool):
        path = _path(folder, pool, name, closed_forms)
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            found = score_closed_forms(name, scenes) if closed_forms else score_networks(name, scenes, networks)
            write_bytes(path, json.dumps(found, indent=1).encode())
            print(name, flush=True)
    print(table(folder, pool))


def _path(folder: Path, pool: str, name: str, closed_forms: bool) -> Path:
    return folder / f"{'closed-forms' if closed_forms else 'networks'}-{pool}" / f"{name}.json"


def table(folder: Path, pool: str) -> str:
    """Return, for each camera and light, decibels over the best closed form with its settings by the truth."""
    lines, gains = [], []
    for name in scored_cameras(pool):
        first, second = (_path(folder, pool, name, closed_forms) for closed_forms in (True, False))
        if not first.exists():
            continue
        found = json.loads(first.read_text())
        if second.exists():
            for row, more in zip(found["scores"], json.loads(second.read_text()), strict=True):
                row.update(more)
        for electrons in ELECTRONS:
            rows = [row for row in found["scores"] if row["electrons"] == electrons]
            choices = torch.tensor([row["choices"] for row in rows])
            best = choices[:, choices.mean(0).argmax()]
            keys = [key for key in rows[0] if key not in {"scene", "electrons", "choices", "capture"}]
            over = {key: torch.tensor([row[key] for row in rows]) - best for key in keys}
            told = ", ".join(
                f"{key} {float(value.mean()):+.2f} ({float(value.min()):+.2f})" for key, value in over.items()
            )
            lines.append(f"{name} {electrons:.0f} e-: best {float(best.mean()):.2f} dB; {told}; {found['camera']}")
            if name not in SHIPPED:
                gains.append((electrons, over))
    for electrons in ELECTRONS:
        for key in gains[0][1] if gains else ():
            each = torch.cat([over[key] for light, over in gains if light == electrons and key in over])
            lines.append(
                f"all {electrons:.0f} e-, {key}: mean {float(each.mean()):+.3f}, least {float(each.min()):+.2f}, "
                f"below -.1 in {float((each < -0.1).float().mean()):.1%} of {len(each)}"
            )
    return "\n".join(lines)
