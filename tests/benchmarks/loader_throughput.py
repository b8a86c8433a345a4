"""Images per second of a data loader, raw and with the camera, and their ratio, in one run.

``python -m tests.benchmarks.loader_throughput`` reads scenes from files with 0 workers and with 2. The loaders take
turns, so that a busy machine slows all alike, and the median of the rounds counts.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from pathlib import Path

import torch
from torch.utils.data import DataLoader

from kornia_tidy import TiDyOptics
from kornia_tidy.data import RGBDFolder, write_depth, write_image


def rate(loader: DataLoader) -> float:
    """Return the images per second of one epoch, the start of its workers included."""
    start = time.perf_counter()
    count = sum(len(batch["image"]) for batch in loader)
    return count / (time.perf_counter() - start)


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
        transforms = {"raw": None, "camera": TiDyOptics().as_transform()}
        print(f"{args.images} images of {args.size} x {args.size} px a round, {torch.get_num_threads()} thread")
        for workers in (0, 2):
            loaders = {
                name: DataLoader(
                    RGBDFolder(folder, "*.png", "*_depth.pfm", transform=transform), batch_size=8, num_workers=workers
                )
                for name, transform in transforms.items()
            }
            rounds = [[rate(loader) for loader in loaders.values()] for _ in range(args.rounds + 1)][1:]
            raw, coded = (statistics.median(column) for column in zip(*rounds, strict=True))
            print(f"{workers} workers: raw {raw:.0f} /s, with the camera {coded:.0f} /s, ratio {coded / raw:.2f}")


if __name__ == "__main__":
    main()
