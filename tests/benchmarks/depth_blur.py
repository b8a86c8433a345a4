"""RandomDepthBlur beside the Gaussian blurs of kornia, OpenCV and albumentations, in one run.

``python -m tests.benchmarks.depth_blur`` prints the processor time of one image of 640 x 480 pixels on one thread: the
median of calls that take turns. albumentations is timed where it is installed. Each call of RandomDepthBlur has its own
draw. The last line is a scene with many objects, whose tiles hold many depths.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from importlib.util import find_spec
from typing import Any

import cv2
import kornia.augmentation as K
import torch

from kornia_tidy.augmentation import RandomDepthBlur
from kornia_tidy.data import dead_leaves, sample_scene
from tests.benchmarks.rendering_against_peers import in_turn

SIDE = 33  # pixels of the Gaussian blurs; the largest disc of RandomDepthBlur has as many


def calls() -> dict[str, Callable[[], Any]]:
    """Return the calls that are timed by their names."""
    (image, depth, _), (leaves, near) = sample_scene(), dead_leaves(480, 640, depth_range=(0.3, 10.0))
    array = image.permute(1, 2, 0).contiguous().numpy()
    wide = RandomDepthBlur((1.0, 1.0), (2.0, 2.0), compositing="occlusion", p=1.0)
    gaussian, blur = K.RandomGaussianBlur((SIDE, SIDE), (8.0, 8.0), p=1.0), RandomDepthBlur(p=1.0)
    found: dict[str, Callable[[], Any]] = {
        "kornia RandomGaussianBlur": lambda: gaussian(image[None]),
        "cv2.GaussianBlur": lambda: cv2.GaussianBlur(array, (SIDE, SIDE), 8.0),
        "RandomDepthBlur": lambda: blur(image[None], depth[None]),
        "RandomDepthBlur, f/2, occlusion": lambda: wide(image[None], depth[None]),
        "RandomDepthBlur, many objects": lambda: blur(leaves[None], near[None]),
    }
    if find_spec("albumentations") is not None:
        import albumentations as A

        of_arrays = A.Compose([A.GaussianBlur(blur_limit=(SIDE, SIDE), sigma_limit=(8.0, 8.0), p=1.0)])
        found["albumentations GaussianBlur"] = lambda: of_arrays(image=array)
    return found


def main(arguments: Sequence[str] | None = None) -> dict[str, float]:
    """Print the medians in milliseconds and return them."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.depth_blur", description=__doc__)
    parser.add_argument("--rounds", type=int, default=25, help="times of which medians are taken (25)")
    rounds = parser.parse_args(arguments).rounds
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    torch.manual_seed(0)
    with torch.no_grad():
        medians = in_turn(calls(), rounds, time.thread_time)
    for name, median in medians.items():
        print(f"{name:34} {median:7.1f} ms")
    return medians


if __name__ == "__main__":
    main()
