"""Photograph a data set once, then train a network on the captures on disk: plain PyTorch, no camera in the loop.

    python examples/train_on_rendered.py --output outputs/captures

Worth it while the masks stay as they are: a capture is then made once, not in every epoch. To learn the masks, call
the camera in the loop, as plain_training_loop.py does. `kornia-tidy render` writes the same files from a shell.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import torch
from torch.utils.data import DataLoader

from kornia_tidy import TiDyOptics
from kornia_tidy.data import DeadLeaves
from kornia_tidy.reconstruction.heads import PlainHead
from kornia_tidy.training.coded_datasets import CodedCaptures, Layout, render_scenes


def main(arguments: Sequence[str] | None = None) -> list[float]:
    """Photograph the scenes that are missing, train, and return the losses."""
    options = parse(arguments)
    optics = TiDyOptics.from_preset("tidy-5", generator=torch.Generator().manual_seed(0))
    scenes = DeadLeaves(options.scenes, options.size, options.size, depth_range=(0.3, float("inf")))
    made, found = render_scenes(optics, scenes, options.output, Layout(shard_items=8), jobs=options.jobs)
    print(f"{made} captures made, {found} found in {options.output}")

    torch.manual_seed(0)
    network = PlainHead(out_channels=3)
    optimizer = torch.optim.Adam(network.parameters(), lr=2e-3)
    losses = []
    for epoch in range(options.epochs):
        for batch in DataLoader(CodedCaptures(options.output), batch_size=4, shuffle=True):
            loss = (network(batch["coded"]) - batch["image"]).square().mean()  # the all-in-focus image
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            losses.append(float(loss.detach()))
        print(f"epoch {epoch + 1}: loss {losses[-1]:.4f}")
    return losses


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenes", type=int, default=32, help="scenes (default: 32)")
    parser.add_argument("--size", type=int, default=128, help="side of a scene in pixels (default: 128)")
    parser.add_argument("--epochs", type=int, default=10, help="passes over the captures (default: 10)")
    parser.add_argument("--jobs", type=int, default=1, help="processes that render (default: 1)")
    parser.add_argument("--output", default="outputs/captures", help="folder (default: outputs/captures)")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    main()
