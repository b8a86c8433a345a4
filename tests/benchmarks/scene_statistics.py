"""Measures the statistics of scenes on half A of the real scenes, from which ``PHOTOGRAPHS`` was taken.

``python -m tests.benchmarks.scene_statistics`` prints the statistics of half A, and how well the power law fits.
"""

from __future__ import annotations

import argparse
import sys

import torch
from torch import Tensor

from kornia_tidy.data import central_crop
from kornia_tidy.data.statistics_measurement import linear_light, measured_statistics, radial_spectrum
from tests.scenes import ENTRIES, halves, load_scene

LARGEST = 512  # pixels; of real scenes the middle


def half_a() -> tuple[list[Tensor], list[Tensor]]:
    """Return pictures and depths (zero where unknown) of half A, the middles of scenes."""
    images, depths = [], []
    for name in halves(ENTRIES)[0]:
        image, depth, valid = load_scene(name)
        size = tuple(min(LARGEST, side) for side in image.shape[-2:])
        middle = central_crop({"image": image, "depth": depth.where(valid, 0)}, (size[0], size[1]))
        images.append(middle["image"])
        depths.append(middle["depth"])
    return images, depths


def main() -> None:
    """Run the command."""
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    images, depths = half_a()
    found = measured_statistics(images, depths)
    print(found)
    measured = radial_spectrum([linear_light(image) for image in images])
    fitted = found.spectrum(measured.frequency)
    print("| cycles per pixel | density | fitted / measured |\n|---|---|---|")
    for frequency, density, model in zip(*measured, fitted, strict=True):
        print(f"| {frequency:.4f} | {density:.3g} | {model / density:.2f} |")


if __name__ == "__main__":
    torch.set_num_threads(1)
    sys.exit(main())
