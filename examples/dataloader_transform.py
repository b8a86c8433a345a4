"""Put the camera into a data loader: every item is photographed where it is loaded, with noise of its own.

    python examples/dataloader_transform.py --workers 2

The noise is keyed by the item's index, so the data set is the same for any number of workers, and in every epoch.
To learn the masks, call the camera on the batch instead: no gradient leaves a worker.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence

import torch
from torch.utils.data import DataLoader

from kornia_tidy import TiDyOptics
from kornia_tidy.data import DeadLeaves


def main(arguments: Sequence[str] | None = None) -> list[torch.Tensor]:
    """Load all batches, with and without workers, and return the coded images of the first."""
    options = parse(arguments)
    torch.manual_seed(0)
    optics = TiDyOptics()
    data = DeadLeaves(options.items, options.size, options.size, transform=optics.as_transform(seed=7))

    start = time.perf_counter()
    coded = [batch["image"] for batch in DataLoader(data, options.batch, num_workers=options.workers)]
    seconds = time.perf_counter() - start
    print(f"{options.items} scenes of {options.size}x{options.size} in {seconds:.1f} s by {options.workers} workers")
    print(f"batches of shape {tuple(coded[0].shape)}, gradients: {coded[0].requires_grad}")

    again = [batch["image"] for batch in DataLoader(data, options.batch)]
    same = all(torch.equal(a, b) for a, b in zip(coded, again, strict=True))
    print(f"without workers, bit for bit the same: {same}")
    return coded


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--items", type=int, default=16, help="scenes (default: 16)")
    parser.add_argument("--size", type=int, default=128, help="side of a scene in pixels (default: 128)")
    parser.add_argument("--batch", type=int, default=4, help="scenes in a batch (default: 4)")
    parser.add_argument("--workers", type=int, default=2, help="worker processes (default: 2)")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    main()
