"""A small camera and small scenes, and whole folders to compare byte by byte."""

from __future__ import annotations

from pathlib import Path

import torch

from kornia_tidy import Fidelity, PixelwiseMask, TiDyOptics
from kornia_tidy.data import DeadLeaves

FAST = Fidelity.preset("draft").replace(window=23)


def small_camera(**options) -> TiDyOptics:
    masks = PixelwiseMask(2, generator=torch.Generator().manual_seed(1))
    return TiDyOptics(masks, **{"fidelity": FAST, "border": "replicate", **options})


def small_scenes(count: int = 5) -> DeadLeaves:
    return DeadLeaves(count, 40, 48, num_leaves=30, seed=2)


class RandomScenes(torch.utils.data.Dataset):
    """Scenes of tensors alone, drawn from torch's global generator; one of them is beyond the camera's range."""

    def __len__(self) -> int:
        return 3

    def __getitem__(self, index: int) -> dict[str, torch.Tensor]:
        depth = torch.full((1, 32, 32), 1.0)
        depth[0, :2] = 0.2 if index == 1 else float("inf")
        return {"image": torch.rand(3, 32, 32), "depth": depth}


def contents(folder: Path) -> dict[str, bytes]:
    """Every file of a folder by its path in it, hidden ones too."""
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}
