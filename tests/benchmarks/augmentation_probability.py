"""How much less an augmentation costs that is applied to a tenth of the images, in one run.

``python -m tests.benchmarks.augmentation_probability`` prints, for each augmentation, the time of a batch at p = 1 and
at p = 0.1, and their ratio. Calls of both take turns, so that a busy machine slows both alike. At p = 0.1 the same
number of images as on average is changed in each call: one of ten.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import kornia.augmentation as K
import torch
from torch import Tensor

from kornia_tidy import TiDyOptics
from kornia_tidy.augmentation import RandomDepthBlur, RandomSensorNoise, RandomTiDyOptics

BATCH = 10
KINDS: dict[str, Callable[[float], K.IntensityAugmentationBase2D]] = {
    "RandomTiDyOptics": lambda p: RandomTiDyOptics(TiDyOptics(), exposure=(0.5, 1.0), noise_level=(0.0, 0.05), p=p),
    "RandomTiDyOptics, focus drawn": lambda p: RandomTiDyOptics(TiDyOptics(), focus_distance=(0.5, 0.8), p=p),
    "RandomDepthBlur": lambda p: RandomDepthBlur(f_number=(8.0, 16.0), p=p),
    "RandomSensorNoise": lambda p: RandomSensorNoise(p=p),
    "kornia RandomGaussianBlur": lambda p: K.RandomGaussianBlur((9, 9), (1.0, 2.0), p=p),
}


def seconds(augmentation: K.IntensityAugmentationBase2D, image: Tensor, depth: Tensor) -> float:
    """Time one call, of which the first tenth of the images is changed unless all are."""
    params = augmentation.forward_parameters(image.shape)
    if augmentation.p < 1:
        params["batch_prob"] = (torch.arange(BATCH) < round(augmentation.p * BATCH)).float()
    given = (image,) if isinstance(augmentation, (RandomSensorNoise, K.RandomGaussianBlur)) else (image, depth)
    start = time.perf_counter()
    augmentation(*given, params=params)
    return time.perf_counter() - start


@torch.no_grad()
def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--size", type=int, default=128, help="side of the images in pixels (default 128)")
    parser.add_argument("--calls", type=int, default=7, help="calls of each; the median counts (default 7)")
    args = parser.parse_args()
    image = torch.rand(BATCH, 3, args.size, args.size)
    depth = 0.4 + torch.rand(BATCH, 1, args.size, args.size)
    print(f"{BATCH} images of {args.size} x {args.size} px, {torch.get_num_threads()} threads")
    print(f"{'':32}{'p = 1':>10}{'p = 0.1':>10}{'ratio':>8}")
    for name, make in KINDS.items():
        both = [make(p) for p in (1.0, 0.1)]
        for augmentation in both:
            seconds(augmentation, image, depth)
        times = [[seconds(augmentation, image, depth) for augmentation in both] for _ in range(args.calls)]
        every, tenth = (sorted(column)[args.calls // 2] for column in zip(*times, strict=True))
        print(f"{name:32}{every * 1e3:8.1f}ms{tenth * 1e3:8.1f}ms{tenth / every:8.2f}", flush=True)


if __name__ == "__main__":
    main()
