"""A fast camera and small scenes for the tests of pipelines. Importable from a data loader's worker processes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import Dataset

from kornia_tidy import Fidelity, TiDyOptics

FAST = Fidelity("fast", window=9, layer_spacing=10.0)


def camera(**options: Any) -> TiDyOptics:
    """A camera with five nodes in defocus and PSFs of 9x9 pixels: a few milliseconds a picture."""
    return TiDyOptics(**{"fidelity": FAST, **options})


def scene(batch: int = 2, channels: int = 3, height: int = 40, width: int = 48, seed: int = 5) -> tuple[Tensor, Tensor]:
    """Noise over a depth that varies over the default camera's whole range, with a sky at infinity."""
    generator = torch.Generator().manual_seed(seed)
    image = torch.rand(batch, channels, height, width, generator=generator)
    depth = 0.3 + 2 * torch.rand(batch, 1, height, width, generator=generator)
    depth[..., :3, :] = torch.inf
    return image, depth


class Scenes(Dataset):
    """Four scenes of 64x64 pixels, each given to every transform."""

    def __init__(self, transforms: Mapping[str, Any]) -> None:
        self.transforms = transforms

    def __len__(self) -> int:
        return 4

    def __getitem__(self, index: int) -> dict[str, Any]:
        image, depth = (x[0] for x in scene(1, height=64, width=64, seed=index))
        sample = {"image": image, "depth": depth, "index": index, "name": f"scene {index}"}
        return {name: transform(sample) for name, transform in self.transforms.items()}
