"""Which closed form is best behind each camera, and how near a rule of PSFs and noise comes to it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import torch
from kornia.color import linear_rgb_to_rgb
from torch import Tensor

from kornia_tidy import SensorNoise
from kornia_tidy.files import write_bytes
from kornia_tidy.reconstruction.bilateral import bilateral_filter
from kornia_tidy.reconstruction.kernel_convolution import convolve_kernels
from kornia_tidy.reconstruction.tikhonov_kernels import tikhonov_kernels
from kornia_tidy.reconstruction.trained import closed_form_bank
from kornia_tidy.reconstruction.wiener_kernels import wiener_kernels
from tests.benchmarks.any_camera.cameras import camera, in_words, pool_names
from tests.benchmarks.any_camera.captures import LEVELS, stored

ELECTRONS = (300.0, 2000.0, 12_000.0, 57_000.0)
READ_ELECTRONS = 2.4
FACTORS = tuple(-1.0 + 0.25 * step for step in range(8))  # of the noise taken, as a logarithm
WEIGHTS = tuple(10 ** (-4.0 + 0.5 * step) for step in range(6))
COLORS = (0.0, 0.03, 0.06, 0.09, 0.12, 0.18, 0.25, 0.36, 0.5)  # 0: no bilateral filter
SCENES = 3


def mean_squared_errors(kernels: Tensor, light: Tensor, truth: Tensor, veil: Tensor) -> Tensor:
    """Return the errors of encoded pictures, (scenes, kernels, colours)."""
    mean = light.mean((-2, -1), keepdim=True)
    estimates = convolve_kernels(light - veil * mean, kernels)
    found = []
    for estimate in estimates.unbind(1):
        image = linear_rgb_to_rgb(estimate.clamp(0, 1))
        smooth = [bilateral_filter(image, color) if color else image for color in COLORS]
        found.append(torch.stack([(one - truth).square().mean((1, 2, 3)) for one in smooth], 1))
    return torch.stack(found, 1)


@torch.no_grad()
def measured(folder: Path, name: str) -> dict[str, Any]:
    """Return the errors of every choice behind a camera, and what is known of it without the truth."""
    optics = camera(name)
    bank, captures = closed_form_bank(optics), stored(folder / "captures", name)
    psfs = bank.psfs
    energy = psfs.mean(0).sum((-2, -1))
    veil = psfs.new_zeros(3) if bank.veil is None else bank.veil.mean(0)
    share = (veil / (energy + veil))[:, None, None]
    light, image = (torch.from_numpy(part[:SCENES].astype("float32")) / LEVELS for part in captures)
    truth, found = linear_rgb_to_rgb(image), []
    tikhonov = tikhonov_kernels(psfs.mean(0), WEIGHTS)
    for electrons in ELECTRONS:
        sensor = SensorNoise(READ_ELECTRONS / electrons, full_well=electrons)
        noisy = sensor(light, generator=torch.Generator().manual_seed(0))
        noise = float(sensor.std(noisy).square().mean().sqrt())
        kernels = wiener_kernels(psfs, tuple(noise * 10**factor for factor in FACTORS))
        found.append(
            {
                "electrons": electrons,
                "noise": noise,
                "mean": float(noisy.mean()),
                "norms": kernels.square().sum((-2, -1)).mean(1).sqrt().tolist(),
                "tikhonov norms": tikhonov.square().sum((-2, -1)).mean(1).sqrt().tolist(),
                "wiener": mean_squared_errors(kernels, noisy, truth, share).tolist(),
                "tikhonov": mean_squared_errors(tikhonov, noisy, truth, share).tolist(),
            }
        )
    return {"name": name, "camera": in_words(optics), "levels": found}


def sweep(folder: Path, pool: str) -> None:
    """Measure all cameras of a pool; those in the folder are kept."""
    for name in pool_names(pool):
        path = folder / "closed_form" / f"{name}.json"
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True)
            write_bytes(path, json.dumps(measured(folder, name)).encode())
            print(name, flush=True)
