"""Trains the small heads that the library ships, and compares five masks with one and with none.

``python -m tests.benchmarks.heads train FOLDER`` trains every system of the table, each in a folder of its own, and
goes on where it stopped; two such commands may share the work (``--tasks``). Everything is decided by ``SETTINGS``.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from kornia_tidy.training.run import train
from kornia_tidy.training.settings import TrainingSettings

SETTINGS = TrainingSettings(
    head="attention-unet", width=8, residual=True, size=128, scenes=480, validation_scenes=24, batch=6, lr=2e-3,
    lr_metres=6e-8, schedule="cosine", epochs=8, ema=0.99, precision="bf16-mixed",
)  # fmt: skip
TASKS = ("edof", "joint")
MASKS = (5, 1, 0)  # 0: a fixed Fresnel lens
SEEDS = (0, 1, 2)


def folder_of(root: Path, task: str, masks: int, seed: int) -> Path:
    """Return where a system is trained."""
    return root / f"{task}-{masks}-seed{seed}"


def train_all(root: Path, tasks: list[str], seeds: list[int]) -> None:
    """Train what is not yet trained."""
    for seed in seeds:
        for task in tasks:
            for masks in MASKS:
                folder = folder_of(root, task, masks, seed)
                print(folder.name, flush=True)
                train(SETTINGS.replace(task=task, masks=masks, seed=seed), folder, resume=True, progress=True)


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=("train",))
    parser.add_argument("folder", type=Path)
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
    parser.add_argument("--seeds", nargs="+", type=int, default=list(SEEDS))
    args = parser.parse_args()
    train_all(args.folder, args.tasks, args.seeds)


if __name__ == "__main__":
    sys.exit(main())
