"""``python -m tests.benchmarks.any_camera photograph FOLDER``, then ``train``; see ``--help``."""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from tests.benchmarks.any_camera.cameras import POOLS
from tests.benchmarks.any_camera.captures import photograph
from tests.benchmarks.any_camera.closed_form import sweep
from tests.benchmarks.any_camera.training import train


def main() -> None:
    """Run one step."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("step", choices=("photograph", "sweep", "train"))
    parser.add_argument("folder", type=Path, help="of captures, checkpoints and scores; a step goes on where it ended")
    parser.add_argument("--pool", choices=tuple(POOLS), default="training")
    parser.add_argument("--steps", type=int, default=2400)
    options = parser.parse_args()
    torch.set_num_threads(1)
    if options.step == "photograph":
        photograph(options.folder / "captures", options.pool)
    elif options.step == "sweep":
        sweep(options.folder, options.pool)
    else:
        train(options.folder, options.steps)


if __name__ == "__main__":
    main()
