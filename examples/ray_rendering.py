"""Photograph a data set with Ray Data: on one machine, or on all machines of a Ray cluster that share a folder.

    pip install 'ray[data]'
    python examples/ray_rendering.py --scenes 32 --workers 2 --output outputs/ray_captures

The folder is the one that `kornia-tidy render` writes, to the last byte: `CodedCaptures(folder)` reads it. Each row of
the Ray data set is the number of a shard. A shard appears under its name when it is complete, so that Ray may repeat
what a lost machine had begun, and the same command goes on after an interruption.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from typing import Any

import torch

from kornia_tidy.cli.commands.render import OF_CAMERA, OF_SCENES
from kornia_tidy.reconstruction.trained import build_optics
from kornia_tidy.training.coded_datasets import Layout, render_scenes
from kornia_tidy.training.data_sets import make_scenes
from kornia_tidy.training.settings import TrainingSettings


class Photographer:
    """A worker that makes camera and scenes once, and photographs the parts that it is given."""

    def __init__(self, settings: dict[str, Any], folder: str, parts: int, layout: Layout) -> None:
        torch.set_num_threads(1)  # Ray runs a worker on each core
        chosen = TrainingSettings().replace(**settings)
        self.optics, self.scenes = build_optics(chosen), make_scenes(chosen, "train", chosen.scenes)
        values = chosen.as_dict()
        self.made_from = {
            "options": {name: getattr(chosen, name) for name in OF_CAMERA},
            "split": "train",
            "scenes": {name: values[name] for name in OF_SCENES},
        }
        self.folder, self.parts, self.layout = folder, parts, layout

    def __call__(self, batch: dict[str, Any]) -> dict[str, Any]:
        """Return the number of captures that were made in each part."""
        made = [
            render_scenes(
                self.optics, self.scenes, self.folder, self.layout, rank=int(part), world=self.parts,
                made_from=self.made_from,
            ).made
            for part in batch["id"]
        ]  # fmt: skip
        return {**batch, "made": torch.tensor(made).numpy()}


def main(arguments: Sequence[str] | None = None) -> int:
    """Photograph what is missing, and return the number of captures that were made."""
    options = parse(arguments)
    try:
        import ray  # noqa: PLC0415
    except ImportError:
        raise SystemExit("this example needs Ray: pip install 'ray[data]'") from None
    settings = {
        "scenes": options.scenes,
        "validation_scenes": options.scenes,
        "size": options.size,
        "masks": options.masks,
    }
    layout = Layout(shard_items=options.shard_items)
    parts = len(layout.parts(options.scenes))
    if not ray.is_initialized():  # here: a core more than the workers, for the numbers of the parts
        ray.init(
            **({} if "RAY_ADDRESS" in os.environ else {"num_cpus": options.workers + 1, "include_dashboard": False})
        )
    worker = (settings, options.output, parts, layout)
    counted = ray.data.range(parts, override_num_blocks=min(parts, 4 * options.workers)).map_batches(
        Photographer, fn_constructor_args=worker, batch_size=1, concurrency=options.workers, num_cpus=1
    )
    made = int(counted.sum("made"))
    print(f"{made} captures made, {options.scenes - made} found in {options.output}")
    return made


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=32, help="painted scenes (default: 32)")
    parser.add_argument("--size", type=int, default=128, help="side of a scene in pixels (default: 128)")
    parser.add_argument("--masks", type=int, default=5, help="random masks of the camera (default: 5)")
    parser.add_argument("--shard-items", type=int, default=8, help="captures in a tar file (default: 8)")
    parser.add_argument("--workers", type=int, default=2, help="processes of Ray, one core each (default: 2)")
    parser.add_argument("--output", default="outputs/ray_captures", help="a folder that all machines see")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    main()
