"""Training of the network alone: images a second, and which scenes and captures train better networks.

- ``python -m tests.benchmarks.network_training speed``: images of 128 px a second of a whole step (loading, forward,
  backward, optimiser, average), by the pipeline that photographs each batch and by the one whose captures are rendered
  once.
- ``... scenes [--seconds S] [--seeds N]``: a short training on dead leaves, on photographic leaves, and on these with
  occlusion; then the PSNR on real scenes of half A, which none of them was trained on.

One thread; times are those of the process on the processor, so that it matters less what else runs there.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from kornia_tidy import SensorNoise
from kornia_tidy.data.patches import central_crop
from kornia_tidy.reconstruction.metrics import psnr
from kornia_tidy.reconstruction.pretrained import load_pretrained
from kornia_tidy.reconstruction.tasks import stretched
from kornia_tidy.reconstruction.trained import build_head, build_optics
from kornia_tidy.training.data_sets import make_scenes
from kornia_tidy.training.module import TidyTraining, cosine_rate
from kornia_tidy.training.noise_free import NoiseFreeCaptures
from kornia_tidy.training.noisy_crops import NoisyCrops
from kornia_tidy.training.scenes import SceneLoader
from kornia_tidy.training.settings import NETWORK_RUN, TrainingSettings
from kornia_tidy.training.task_loss import LOSSES, task_loss
from tests.benchmarks.scene_likeness import half_a
from tests.scenes import ENTRIES, load_scene

HEAD: dict[str, Any] = {"head": "attention-unet", "width": 8, "closed_form": False, "residual": True, "refocus": 5}
HEAD["crop"] = 128
SETTINGS = TrainingSettings(**{**NETWORK_RUN, **HEAD, "sigma": 0.002})
STEPS = 12
NOISES = (0.002, 0.01, 0.03)
REAL, SIDE = 8, 320  # scenes of half A, middle pixels


def prepared(settings: TrainingSettings, shipped_head: bool = False) -> TidyTraining:
    """Return a module with the shipped camera of five masks, and a new network or the shipped one."""
    torch.manual_seed(settings.seed)
    shipped = load_pretrained("edof-5")
    optics = build_optics(settings.replace(window=shipped.optics.window))
    optics.masks.load_state_dict(shipped.optics.masks.state_dict())
    rates = {"lr": settings.lr, "learn": settings.learn, "channels_last": settings.channels_last}
    head = shipped.head.requires_grad_() if shipped_head else build_head(settings)
    return TidyTraining(optics, head, settings.task, LOSSES[settings.loss], **rates, settings=settings)


def batches(module: TidyTraining, folder: Path) -> Iterator[dict[str, Any]]:
    """Yield the batches of epoch after epoch."""
    settings = module.settings
    assert settings is not None
    scenes: Any = make_scenes(settings, "train")
    if settings.learn == "network":
        scenes = NoisyCrops(NoiseFreeCaptures(scenes, module.optics, folder), module.optics, settings.crop)
    for index in range(len(scenes)):
        scenes[index]  # painted or rendered before the clock starts
    loader = SceneLoader(scenes, settings.batch, seed=settings.seed, augment=settings.augment)
    epoch = 0
    while True:
        loader._batches.start(epoch, 0)
        yield from loader
        epoch += 1


def clocked_steps(module: TidyTraining, folder: Path, seconds: float = 0.0, bf16: bool = False) -> list[float]:
    """Train for some seconds of the process, or else for ``STEPS`` steps, and return the seconds of each step."""
    optimizer = module.configure_optimizers()
    rates = [group["lr"] for group in optimizer.param_groups]
    module.train().on_fit_start()
    source, taken = batches(module, folder), []
    pending = next(source)  # paints or renders all scenes
    while sum(taken) < seconds if seconds else len(taken) < STEPS:
        start = time.process_time()
        for group, rate in zip(optimizer.param_groups, rates, strict=True):
            group["lr"] = rate * cosine_rate(sum(taken) / seconds) if seconds else rate
        optimizer.zero_grad()
        with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
            result = module.reconstruct(pending)
        task_loss(module.loss, result.estimate, result.truth, result.mask, module.weights).backward()
        optimizer.step()
        assert module.average is not None
        module.average.update(module.head)
        pending = next(source)
        taken.append(time.process_time() - start)
    return taken


def speed() -> None:
    """Print images a second of each pipeline."""
    live = SETTINGS.replace(learn="both", data="dead-leaves", size=128, crop=None, scenes=24, loss="mse")
    once = SETTINGS.replace(scenes=24)
    rows = {
        "photographed for each step, float32": (live, False),
        "photographed for each step, bfloat16": (live, True),
        "rendered once, float32": (once, False),
        "rendered once, float32, channels last": (once.replace(channels_last=True), False),
        "rendered once, bfloat16": (once, True),
        "rendered once, bfloat16, channels last": (once.replace(channels_last=True), True),
    }
    print("| pipeline | images of 128 px a second |\n|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for name, (settings, bf16) in rows.items():
            taken = clocked_steps(prepared(settings), Path(folder), bf16=bf16)[2:]
            print(f"| {name} | {settings.batch / statistics.median(taken):.1f} |", flush=True)


@torch.no_grad()
def scores(module: TidyTraining) -> dict[float, list[float]]:
    """Return the PSNR on real scenes of half A at each noise, and of the capture under the key 0."""
    module.eval()
    names = [name for name in half_a() if not name.startswith("flying")][:REAL]
    found: dict[float, list[float]] = {0.0: [], **{noise: [] for noise in NOISES}}
    for number, name in enumerate(names):
        image, depth, valid = load_scene(name)
        size = tuple(min(SIDE, side // 16 * 16) for side in image.shape[-2:])
        depth = stretched(depth, valid, module.optics.camera)  # ty: ignore[invalid-argument-type]
        sample = central_crop({"image": image.expand(3, -1, -1), "depth": depth}, (size[0], size[1]))
        truth: Tensor = sample["image"][None]
        for noise in NOISES:
            module.optics.sensor = SensorNoise(noise)
            generator = torch.Generator().manual_seed(number)
            coded = module.optics(truth, sample["depth"][None], generator=generator)
            found[noise] += psnr(module(coded, torch.full((1, 1, 1, 1), noise)).clamp(0, 1), truth).tolist()
            if noise == NOISES[0]:
                found[0.0] += psnr(coded, truth).tolist()
    return found


def scenes(seconds: float, seeds: int, kinds: list[str], folder: Path, shipped_head: bool) -> None:
    """Print a table of networks that were trained for the same time on other captures."""
    print("| captures | seed | steps | capture | " + " | ".join(f"noise {noise:g}" for noise in NOISES) + " |")
    print("|---" * (4 + len(NOISES)) + "|")
    for seed in range(seeds):
        for name in kinds:
            settings = SETTINGS.replace(**KINDS[name], seed=seed, scenes=160, ema=0.99)
            module = prepared(settings.replace(lr=5e-4) if shipped_head else settings, shipped_head)
            steps = len(clocked_steps(module, folder / f"{name}-{seed}", seconds)) if seconds else 0
            found = scores(module)
            print({noise: [round(value, 2) for value in values] for noise, values in found.items()}, file=sys.stderr)
            cells = [f"{statistics.fmean(values):.2f}" for values in found.values()]
            print(f"| {name} | {seed} | {steps} | {' | '.join(cells)} |", flush=True)


KINDS: dict[str, dict[str, Any]] = {
    "dead leaves": {"data": "dead-leaves"},
    "photographic leaves": {"data": "photographic-leaves"},
    "photographic leaves, occlusion": {"data": "photographic-leaves", "compositing": "occlusion"},
}


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=("speed", "scenes"))
    parser.add_argument("--seconds", type=float, default=55, help="of a training (default: 55)")
    parser.add_argument("--seeds", type=int, default=1, help="(default: 1)")
    parser.add_argument("--shipped", action="store_true", help="go on with the shipped network, at a rate of 5e-4")
    parser.add_argument("--kinds", nargs="+", choices=tuple(KINDS), default=list(KINDS))
    parser.add_argument("--captures", type=Path, help="folder of the captures (default: a temporary one)")
    args = parser.parse_args()
    torch.set_num_threads(1)
    if args.command == "speed":
        speed()
        return
    if not ENTRIES:
        raise SystemExit("../shared/data is not on this machine: there are no photographs to score")
    with tempfile.TemporaryDirectory() as folder:
        scenes(args.seconds, args.seeds, args.kinds, args.captures or Path(folder), args.shipped)


if __name__ == "__main__":
    sys.exit(main())
