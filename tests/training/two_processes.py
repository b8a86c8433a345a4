"""Train on one process that accumulates two batches, or on two that see one each. Run by test_distributed.py."""

from __future__ import annotations

import sys
from pathlib import Path

import torch

from kornia_tidy.training.run import train
from kornia_tidy.training.settings import TrainingSettings

SETTINGS = TrainingSettings(
    task="joint", masks=2, head="plain", width=4, size=48, scenes=40, validation_scenes=2, batch=1, epochs=1,
    window=23, lr=1e-3,
)  # fmt: skip


if __name__ == "__main__":
    torch.set_num_threads(1)
    folder, processes = Path(sys.argv[1]), int(sys.argv[2])
    if processes == 1:
        train(SETTINGS.replace(accumulate=2), folder)
    else:
        train(SETTINGS, folder, devices=2, strategy="ddp")
