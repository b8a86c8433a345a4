"""``python -m tests.benchmarks.any_camera photograph FOLDER``, then ``train``; see ``--help``."""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from kornia_tidy.data import photographs_in
from kornia_tidy.reconstruction.any_camera import WEIGHTS
from tests.benchmarks.any_camera.cameras import POOLS
from tests.benchmarks.any_camera.captures import photograph, photograph_collages, photograph_pictures
from tests.benchmarks.any_camera.guards import measure
from tests.benchmarks.any_camera.scores import averaged, first_weights, mixed, score_pool
from tests.benchmarks.any_camera.training import ship, train


def main() -> None:
    """Run one step."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("step", choices=("photograph", "train", "closed-forms", "score", "guards", "ship"))
    parser.add_argument("folder", type=Path, help="of captures, checkpoints and scores; a step goes on where it ended")
    parser.add_argument("--pool", choices=tuple(POOLS), default="training")
    parser.add_argument("--photographs", type=Path, help="folder, for collages and whole ones")
    parser.add_argument("--share", type=float, default=0.0, help="of the first weights in those that are shipped")
    parser.add_argument("--steps", type=int, default=2400)
    options = parser.parse_args()
    torch.set_num_threads(1)
    if options.step == "photograph":
        if options.photographs is None:
            photograph(options.folder / "captures", options.pool)
        else:
            photographs = photographs_in(options.photographs)
            photograph_collages(options.folder / "captures", photographs)
            photograph_pictures(options.folder / "captures", photographs)
    elif options.step == "train":
        train(options.folder, options.steps)
    elif options.step == "guards":
        measure(options.folder)
    elif options.step == "ship":
        ship(mixed(averaged(options.folder), first_weights(options.folder), options.share), WEIGHTS)
    else:
        score_pool(options.folder, options.pool, closed_forms=options.step == "closed-forms")


if __name__ == "__main__":
    main()
