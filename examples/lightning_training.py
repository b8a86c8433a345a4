"""Train a camera and a network of your own with Lightning's trainer, then load and use both.

    python examples/lightning_training.py --epochs 3

Needs pip install 'kornia-tidy[train]'. For the library's own networks and data there is `kornia-tidy train`.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor, nn

from kornia_tidy import PixelwiseMask, TiDyOptics
from kornia_tidy.data import DeadLeaves
from kornia_tidy.reconstruction.trained import load_weights


class OwnNetwork(nn.Module):
    """Any network will do that returns three channels for the task edof."""

    def __init__(self) -> None:
        super().__init__()
        self.correction = nn.Sequential(
            nn.Conv2d(3, 16, 5, padding=2), nn.ReLU(), nn.Conv2d(16, 16, 5, padding=2), nn.ReLU(), nn.Conv2d(16, 3, 1)
        )

    def forward(self, coded: Tensor) -> Tensor:
        """Return the all-in-focus image."""
        return coded + self.correction(coded)


def main(arguments: Sequence[str] | None = None) -> float:
    """Train, load the weights into new objects, and return the root mean square error of a scene."""
    options = parse(arguments)
    import lightning.pytorch as pl  # noqa: PLC0415 (so that --help needs no extra)

    from kornia_tidy.training.callbacks import SaveCheckpoints  # noqa: PLC0415
    from kornia_tidy.training.checkpoint import SafetensorsIO  # noqa: PLC0415
    from kornia_tidy.training.data_module import SceneData  # noqa: PLC0415
    from kornia_tidy.training.module import TidyTraining  # noqa: PLC0415

    torch.manual_seed(0)
    folder = Path(options.output)
    module = TidyTraining(TiDyOptics(PixelwiseMask(3)), OwnNetwork(), task="edof", lr=1e-3, ema=0.9)
    shape = {"height": options.size, "width": options.size, "depth_range": (0.3, float("inf"))}
    scenes = [DeadLeaves(count, **shape, seed=seed) for seed, count in enumerate((options.scenes, 4))]
    trainer = pl.Trainer(
        accelerator="cpu",
        max_epochs=options.epochs,
        plugins=[SafetensorsIO()],
        callbacks=[SaveCheckpoints(folder)],
        use_distributed_sampler=False,
        enable_checkpointing=False,
        logger=False,
        enable_model_summary=False,
        enable_progress_bar=False,
    )
    trainer.fit(module, SceneData(*scenes, batch=4))

    optics, network = module.optics, OwnNetwork()
    load_weights(folder / "best.safetensors", optics, network)
    scene = scenes[1][0]
    with torch.no_grad():
        image = scene["image"][None]
        estimate = network(optics(image, scene["depth"][None]))
    error = float((estimate - image).square().mean().sqrt())
    print(f"{folder / 'best.safetensors'}: a scene is reconstructed with an error of {error:.4f}")
    return error


def parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--epochs", type=int, default=3, help="passes over the scenes (default: 3)")
    parser.add_argument("--scenes", type=int, default=32, help="number of scenes (default: 32)")
    parser.add_argument("--size", type=int, default=96, help="side of a scene in pixels (default: 96)")
    parser.add_argument("--output", default="outputs/lightning_training", help="folder of the checkpoints")
    return parser.parse_args(arguments)


if __name__ == "__main__":
    main()
