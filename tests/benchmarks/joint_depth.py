"""Trains a small joint network that tells how uncertain its depth is, and scores it on real scenes.

The camera is that of ``joint-5``, which earlier versions shipped, whose masks stay as they are. Scenes are dead leaves,
photographed once without noise; crops and noise are drawn for each step. None of the scenes of the tables is trained
on.

- ``python -m tests.benchmarks.joint_depth train FILE``: the network, as a checkpoint of the library; ``--steps``.
- ``... score FILE``: half of the real scenes, those of ``scenes.json`` that a fixed seed chooses for choosing settings;
  writes FILE.md with the table and FILE.png with reliability and sparsification.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from kornia.color import linear_rgb_to_rgb, rgb_to_linear_rgb
from kornia.filters import box_blur
from torch import Tensor
from tqdm import tqdm

from examples.paper.shipped import load_shipped
from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.data.dead_leaves import DeadLeaves
from kornia_tidy.figures.reliability import Reliability, draw_reliability
from kornia_tidy.reconstruction.depth_distribution import (
    depth_moments,
    distribution_loss,
    fit_temperature,
    soft_targets,
)
from kornia_tidy.reconstruction.head import border_padding
from kornia_tidy.reconstruction.kernel_convolution import convolve_kernels
from kornia_tidy.reconstruction.layered_joint import LayeredJointHead
from kornia_tidy.reconstruction.losses import mse_loss
from kornia_tidy.reconstruction.metrics import psnr, rmse
from kornia_tidy.reconstruction.reliability import reliability_curve, sparsification_curve
from kornia_tidy.reconstruction.settings import SystemSettings
from kornia_tidy.reconstruction.state_file import write_state
from kornia_tidy.reconstruction.tasks import depth_logits, normalised_inverse_depth
from kornia_tidy.reconstruction.trained import build_head, load_trained, update_psfs
from kornia_tidy.training.average import MovingAverage
from kornia_tidy.training.module import cosine_rate
from tests.benchmarks.heads import RealScenes
from tests.benchmarks.standard_error import standard_error

TRAINED, HELD_OUT, SIZE, CROP, BATCH, RATE = 120, 12, 192, 128, 4, 2e-3
SURE = 0.7  # part of the pixels, the surest
SHARES = tuple(share / 20 for share in range(1, 21))
BLANK = 0.01  # standard deviation of the scene's encoded brightness over 9 x 9 pixels, below which there is no texture
SEED = 20261122


def system() -> tuple[TiDyOptics, SystemSettings]:
    """Return the camera, and the settings of the system to train."""
    shipped = load_shipped("joint-5")
    settings = shipped.settings.replace(residual=False, refocus=11, depth_classes=32)
    return shipped.optics, settings


def photographed(optics: TiDyOptics, count: int, seed: int) -> dict[str, Tensor]:
    """Return captures of dead leaves without noise, their images and their normalised inverse depth."""
    sensor, optics.sensor = optics.sensor, None
    scenes = DeadLeaves(count, SIZE, SIZE, depth_range=optics.camera.depth_range, seed=seed)
    captures = []
    for index in tqdm(range(count), desc="photograph", file=sys.stderr, leave=False):
        scene = scenes.read(index)
        sample: Any = optics({"image": scene.image[None], "depth": scene.depth[None]})
        inverse = normalised_inverse_depth(optics.camera, sample["depth"])
        captures.append(torch.cat([sample["image"], sample["all_in_focus"], inverse], 1))
    optics.sensor = sensor
    capture, image, depth = torch.cat(captures).split([3, 3, 1], 1)
    return {"capture": capture, "image": image, "depth": depth}


def noisy(capture: Tensor, sigma: float) -> Tensor:
    """Return an encoded capture with read noise in linear light, clipped as by a sensor."""
    light = rgb_to_linear_rgb(capture.clamp(0, 1))
    return linear_rgb_to_rgb((light + sigma * torch.randn_like(light)).clamp(0, 1))


def crops(scenes: dict[str, Tensor], steps: int) -> Iterator[dict[str, Tensor]]:
    """Yield random crops of random scenes."""
    for _ in range(steps):
        chosen = torch.randint(len(scenes["capture"]), (BATCH,)).tolist()
        corners = torch.randint(SIZE - CROP + 1, (BATCH, 2)).tolist()
        yield {
            name: torch.stack(
                [maps[i, :, y : y + CROP, x : x + CROP] for i, (y, x) in zip(chosen, corners, strict=True)]
            )
            for name, maps in scenes.items()
        }


def train(path: Path, steps: int) -> None:
    """Train the network, fit its temperature to held-out scenes, and write both with the camera."""
    torch.manual_seed(SEED)
    optics, settings = system()
    head = build_head(settings)
    assert isinstance(head, LayeredJointHead)
    with torch.no_grad():
        update_psfs(head, optics)
        scenes, held_out = photographed(optics, TRAINED, SEED), photographed(optics, HELD_OUT, SEED + 1)
    average = MovingAverage(head, 0.99)
    with torch.no_grad():
        update_psfs(average, optics)
    adam = torch.optim.AdamW(head.parameters(), lr=RATE, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.LambdaLR(adam, lambda step: cosine_rate(step / steps))
    bar = tqdm(crops(scenes, steps), total=steps, desc="train", file=sys.stderr, mininterval=10)
    for batch in bar:
        with torch.autocast("cpu", torch.bfloat16):
            output = head(noisy(batch["capture"], settings.sigma))
        output = output.float()
        logits = depth_logits("joint", output)
        assert logits is not None
        depth = distribution_loss(logits, batch["depth"])
        image = mse_loss(output[:, -3:], batch["image"])
        adam.zero_grad()
        (depth + 100 * image).backward()
        adam.step()
        schedule.step()
        average.update(head)
        bar.set_postfix(depth=f"{depth.item():.3f}", image=f"{image.item():.5f}")
    trained = average.network.eval()
    assert isinstance(trained, LayeredJointHead)
    with torch.no_grad():
        parts = [depth_logits("joint", trained(noisy(one[None], settings.sigma))) for one in held_out["capture"]]
        logits = torch.cat([part for part in parts if part is not None])
    trained.temperature.fill_(fit_temperature(logits[..., ::4, ::4], held_out["depth"][..., ::4, ::4]))
    weights = {f"optics.{name}": value for name, value in optics.state_dict().items()}
    weights |= {f"head.{name}": value for name, value in trained.state_dict().items()}
    write_state(path, {"settings": settings.as_dict(), "state_dict": weights, "global_step": steps})
    print(f"temperature {float(trained.temperature):.3f}, {path}")


def ramp(depth: Tensor, known: Tensor) -> Tensor:
    """Return the affine function of the row that is nearest to a depth map where it is known."""
    rows = torch.linspace(-1, 1, depth.shape[-2]).view(1, 1, -1, 1).expand_as(depth)
    terms = torch.stack([torch.ones_like(rows), rows], -1)
    return terms @ torch.linalg.lstsq(terms[known], depth[known][:, None]).solution[:, 0]


def textured(image: Tensor) -> Tensor:
    """Return where the local contrast of a scene is not below :data:`BLANK`."""
    grey = image.mean(1, keepdim=True)
    variance = box_blur(grey.square(), 9) - box_blur(grey, 9).square()
    return variance >= BLANK**2


@torch.no_grad()
def score(path: Path, count: int | None) -> None:
    """Score a checkpoint, and write the table and the figure."""
    trained = load_trained(path)
    optics, head = trained.optics, trained.head
    assert isinstance(head, LayeredJointHead)
    blends: list[Tensor] = []
    head.image_network.register_forward_pre_hook(lambda _, inputs: blends.append(inputs[0][:, 3:6]))
    real = RealScenes(optics.camera)  # ty: ignore[invalid-argument-type]
    chosen = torch.randperm(len(real), generator=torch.Generator().manual_seed(0))[: (len(real) + 1) // 2].tolist()
    rows: list[dict[str, float]] = []
    pooled: dict[str, list[Tensor]] = {name: [] for name in ("depth", "closed", "raw", "fitted", "closed_sd", "truth")}
    for index in tqdm(chosen[:count], desc="score", file=sys.stderr, leave=False):
        scene = real[index]
        noise = torch.Generator().manual_seed(index)
        sample: Any = optics({"image": scene["image"][None], "depth": scene["depth"][None]}, generator=noise)
        capture, image = sample["image"], sample["all_in_focus"]
        truth, known = normalised_inverse_depth(optics.camera, sample["depth"]), scene["mask"][None]
        output = head(capture)
        (left, _, top, _), _ = border_padding((capture.shape[-2], capture.shape[-1]), head.stride)
        blend = blends.pop()[..., top : top + capture.shape[-2], left : left + capture.shape[-1]]
        logits = depth_logits("joint", output)
        assert logits is not None
        depth, deviation = depth_moments(logits)
        raw = depth_moments(logits * head.temperature)
        light = rgb_to_linear_rgb(capture)
        layers = convolve_kernels(light, head.filters)
        by_truth = (soft_targets(truth, head.layers).unsqueeze(2) * layers).sum(1)
        closed, closed_deviation = closed_form(head, light)
        seen, blank = known & textured(image), known & ~textured(image)
        fitted = ramp(truth, known)
        rows.append(
            {
                "image, capture": psnr(capture, image).item(),
                "image, blend by true depth": psnr(linear_rgb_to_rgb(by_truth.clamp(0, 1)), image).item(),
                "image, blend by estimate": psnr(blend, image).item(),
                "image, refined": psnr(output[:, -3:].clamp(0, 1), image).item(),
                **{
                    f"depth RMSE {where}, {name}": rmse(maps, truth, mask).item()
                    for where, mask in (("textured", seen), ("blank", blank), ("all", known))
                    for name, maps in (("ramp", fitted), ("closed form", closed), ("network", depth))
                },
                **{
                    f"depth RMSE surest 70 %, {name}": sparsification_curve(
                        maps, spread, truth, known, shares=(SURE,)
                    ).item()
                    for name, maps, spread in (
                        ("closed form", closed, closed_deviation),
                        ("network", depth, deviation),
                    )
                },
                "bias blank, network": (depth - truth)[blank].mean().item() if blank.any() else float("nan"),
                "deviation textured": deviation[seen].mean().item(),
                "deviation blank": deviation[blank].mean().item() if blank.any() else float("nan"),
            }
        )
        maps = (depth, closed, raw[1], deviation, closed_deviation, truth)
        for name, part in zip(pooled, maps, strict=True):
            pooled[name].append(part[known])
    whole = {name: torch.cat(parts).view(1, 1, 1, -1) for name, parts in pooled.items()}
    curves = {
        name: Reliability(
            reliability_curve(whole[depth], whole[spread], whole["truth"]),
            SHARES,
            sparsification_curve(whole[depth], whole[spread], whole["truth"], shares=SHARES),
        )
        for name, depth, spread in (
            ("closed form", "closed", "closed_sd"),
            ("network", "depth", "raw"),
            (f"network, T = {float(head.temperature):.2f}", "depth", "fitted"),
        )
    }
    lines = [f"| mean of {len(rows)} real scenes | value | standard error |", "|---|---|---|"]
    for name in rows[0]:
        values = [row[name] for row in rows if row[name] == row[name]]
        lines.append(f"| {name} | {statistics.fmean(values):.3f} | {standard_error(values):.3f} |")
    for name, each in curves.items():
        lines.append(f"| calibration error, {name} | {each.curve.calibration_error():.2f} | |")
        lines.append(f"| surest 70 % of all pixels, {name} | {each.errors[SHARES.index(SURE)]:.3f} | |")
    text = "\n".join(lines)
    print(text)
    path.with_suffix(".md").write_text(text + "\n")
    draw_reliability(curves).savefig(path.with_suffix(".png"), dpi=150)


def closed_form(head: LayeredJointHead, light: Tensor) -> tuple[Tensor, Tensor]:
    """Return mean and deviation of the depth by the likelihood in closed form, from which the network begins."""
    return depth_moments(head.closed_form_logits(light))


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=("train", "score"))
    parser.add_argument("file", type=Path)
    parser.add_argument("--steps", type=int, default=400)
    parser.add_argument("--scenes", type=int)
    args = parser.parse_args()
    if args.command == "train":
        train(args.file, args.steps)
    else:
        score(args.file, args.scenes)


if __name__ == "__main__":
    sys.exit(main())
