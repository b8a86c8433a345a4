"""Memory of a data loader that takes pictures: flat over a thousand samples, measured in a process of its own."""

from __future__ import annotations

import subprocess
import sys

import pytest

SAMPLE = 4 * 4 * 64 * 64  # bytes of one image and its depth
LOADED = """
import kornia.augmentation as K
import torch
from torch.utils.data import DataLoader

from kornia_tidy.augmentation import OpticsPipeline, RandomTiDyOptics
from tests.camera.pipeline_samples import Scenes, camera


class Many(Scenes):
    def __len__(self):
        return 1000

    def __getitem__(self, index):
        held.append(super().__getitem__(index)) if keep else None
        return super().__getitem__(index)


def resident():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * 4096


keep, held = {keep}, []
torch.set_num_threads(1)
optics = RandomTiDyOptics(camera(), exposure=(0.5, 1.0), noise_level=(0.0, 0.1), p=0.5)
chain = OpticsPipeline(K.RandomHorizontalFlip(), optics, K.ColorJiggle(0.1, 0.1))
sizes = []
for n, _ in enumerate(DataLoader(Many({{"one": chain.as_transform(seed=1)}}), batch_size=10, num_workers=0)):
    sizes.append(resident())
print(min(sizes[80:]) - min(sizes[20:40]))
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads the memory of a process from Linux' /proc")
def test_feature_no_leak_over_a_thousand_samples():
    """From the third hundred of samples to the last: less than a tenth of what their images and depths would take.

    A leak of a depth map for each of the 600 samples between would add 10 MB, of an image 29 MB, and the bound is 4 MB.
    """
    grown = subprocess.run(
        [sys.executable, "-c", LOADED.format(keep=False)], capture_output=True, text=True, check=True, timeout=280
    )
    assert int(grown.stdout) < 600 * SAMPLE / 10
