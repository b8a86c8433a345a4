"""Growth of the memory of a data loader that takes pictures, in a process of its own.

``python -m tests.augmentation.loader_memory WORKERS CONTEXT KEEP`` loads a thousand samples and prints how much the
process that grew most has grown, in samples, from a third of them to the end: the main process or one of the workers.
With KEEP 1 the data set keeps each sample, a leak that a test of this measurement must see.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from typing import Any

import kornia.augmentation as K
import torch
from torch.utils.data import DataLoader, Dataset, get_worker_info

from kornia_tidy.augmentation import OpticsPipeline, RandomTiDyOptics
from tests.camera.pipeline_samples import camera, scene

SIDE = 64
SAMPLE = 4 * 4 * SIDE**2  # bytes of an image and its depth
COUNT, BATCH = 1000, 10


class Many(Dataset):
    def __init__(self, keep: bool) -> None:
        optics = RandomTiDyOptics(camera(), exposure=(0.5, 1.0), noise_level=(0.0, 0.1), p=0.5)
        chain = OpticsPipeline(K.RandomHorizontalFlip(), optics, K.ColorJiggle(0.1, 0.1))
        self.transform, self.keep, self.kept = chain.as_transform(seed=1), keep, []

    def __len__(self) -> int:
        return COUNT

    def __getitem__(self, index: int) -> dict[str, Any]:
        image, depth = (x[0] for x in scene(1, height=SIDE, width=SIDE, seed=index % 4))
        if self.keep:
            self.kept.append((image.clone(), depth.clone()))
        info = get_worker_info()
        out = self.transform({"image": image, "depth": depth, "index": index})
        return {**out, "worker": -1 if info is None else info.id, "resident": resident()}


def resident() -> int:
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * 4096


def main(workers: int, context: str | None, keep: bool) -> None:
    torch.set_num_threads(1)
    loader = DataLoader(Many(keep), batch_size=BATCH, num_workers=workers, multiprocessing_context=context)
    sizes: dict[int, list[int]] = defaultdict(list)
    for batch in loader:
        sizes[int(batch["worker"][0])] += batch["resident"].tolist()
        sizes[-1].append(resident())
    grown = []
    for found in sizes.values():
        third = len(found) // 3
        grown.append((min(found[-third // 3 :]) - min(found[third : 2 * third])) / SAMPLE)
    print(max(grown))


if __name__ == "__main__":
    main(int(sys.argv[1]), None if sys.argv[2] == "none" else sys.argv[2], sys.argv[3] == "1")
