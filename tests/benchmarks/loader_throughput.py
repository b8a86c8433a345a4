"""Images per second of a data loader, raw, with the camera and with the augmentations, in one run.

``python -m tests.benchmarks.loader_throughput`` reads scenes from files with 0 workers and with 2, which stay between
epochs. The loaders take turns, so that a busy machine slows all alike, and the median of the rounds counts. The first
epoch, which starts workers and fills the memory of PSFs, is left out.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import kornia.augmentation as K
import torch
from torch.utils.data import DataLoader

from kornia_tidy import TiDyOptics
from kornia_tidy.augmentation import (
    DepthAugmentation,
    OpticsPipeline,
    RandomDepthBlur,
    RandomSensorNoise,
    RandomTiDyOptics,
)
from kornia_tidy.data import RGBDFolder, write_depth, write_image


def rate(loader: DataLoader) -> float:
    """Return the images per second of one epoch."""
    start = time.perf_counter()
    count = sum(len(batch["image"]) for batch in loader)
    return count / (time.perf_counter() - start)


def random_transform(augmentation: K.IntensityAugmentationBase2D) -> Callable[[dict[str, Any]], dict[str, Any]]:
    """Return an augmentation as the transform of a data set."""
    if isinstance(augmentation, DepthAugmentation):
        return OpticsPipeline(optics=augmentation).as_transform()
    return partial(noisy, augmentation)


def noisy(augmentation: K.IntensityAugmentationBase2D, sample: dict[str, Any]) -> dict[str, Any]:
    """Change the image of a sample."""
    return {**sample, "image": augmentation(sample["image"])[0]}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=128, help="side of the images in pixels (default 128)")
    parser.add_argument("--images", type=int, default=64, help="images of an epoch (default 64)")
    parser.add_argument("--rounds", type=int, default=5, help="epochs of each; the median counts (default 5)")
    args = parser.parse_args()
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        for index in range(args.images):
            write_image(Path(folder, f"{index}.png"), torch.rand(3, args.size, args.size))
            write_depth(Path(folder, f"{index}_depth.pfm"), 0.4 + torch.rand(1, args.size, args.size))
        transforms = {
            "raw": None,
            "TiDyOptics": TiDyOptics().as_transform(),
            'TiDyOptics, "draft"': TiDyOptics(fidelity="draft").as_transform(),
            "RandomTiDyOptics, p = 0.1": random_transform(RandomTiDyOptics(exposure=(0.5, 1.0), p=0.1)),
            "RandomDepthBlur": random_transform(RandomDepthBlur(f_number=(8.0, 16.0), p=1.0)),
            "RandomSensorNoise": random_transform(RandomSensorNoise(p=1.0)),
        }
        print(
            f"{args.images} images of {args.size} x {args.size} px an epoch, {torch.get_num_threads()} thread a process"
        )
        print(f"{'':28}{'workers':>8}{'images/s':>10}{'of raw':>8}")
        for workers in (0, 2):
            loaders = [
                DataLoader(
                    RGBDFolder(folder, "*.png", "*_depth.pfm", transform=transform),
                    batch_size=8,
                    num_workers=workers,
                    persistent_workers=workers > 0,
                )
                for transform in transforms.values()
            ]
            rounds = [[rate(loader) for loader in loaders] for _ in range(args.rounds + 1)][1:]
            rates = [statistics.median(column) for column in zip(*rounds, strict=True)]
            for name, found in zip(transforms, rates, strict=True):
                print(f"{name:28}{workers:8}{found:10.0f}{found / rates[0]:8.3f}", flush=True)


if __name__ == "__main__":
    main()
