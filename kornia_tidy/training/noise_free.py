"""Noise-free captures of scenes in linear light, rendered once and stored in files: training behind fixed optics."""

from __future__ import annotations

import copy
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from kornia_tidy.camera.tidy_optics import TiDyOptics
from kornia_tidy.data.npy import decode_npy, encode_npy
from kornia_tidy.files import error_prefix, read_bytes, write_bytes
from kornia_tidy.reconstruction.tasks import normalised_inverse_depth
from kornia_tidy.render.repeatable import repeatable
from kornia_tidy.seeds import keyed_seed
from kornia_tidy.training.coded_datasets.conditions import camera_digest, claim
from kornia_tidy.training.random_state import seeded

LEVELS = 2**16 - 1  # of stored values: their rounding is 230 times below the least noise in training, 0.001
CONDITIONS = "captures.json"


class NoiseFreeCapture(NamedTuple):
    """A capture before its noise, with the true maps. Values are in [0, 1]."""

    light: Tensor
    """Capture in linear light without noise, (3, H, W)."""
    image: Tensor
    """All-in-focus scene in linear light, (3, H, W)."""
    inverse_depth: Tensor
    """Normalised inverse depth, (1, H, W)."""
    mask: Tensor
    """bool (1, H, W), True where depth is known."""


class NoiseFreeCaptures(Dataset):
    """Data set of noise-free captures: each scene is rendered when it is first read, and read from a file afterwards.

    A file holds 16 bits a value: 1 MiB for a scene of 256 x 256 pixels. Worker processes and later runs with the same
    camera and scenes may share the folder. An item depends only on its index.

    Args:
        scenes: map-style data set of ``{"image", "depth"}``, with ``"mask"`` where depth is not known everywhere.
        optics: the camera. It is copied: later changes of its masks do not reach the captures.
        folder: of the files; made if missing.
        made_from: how the scenes were made, as plain values. It tells the captures of other scenes apart.

    Raises:
        ValueError: if the folder holds captures of another camera or of other scenes.

    Convention:
        - The capture is clipped to full scale. Gather and scatter of an image in [0, 1] exceed it by round-off only.
        - Captures are never flipped: a flipped capture is one by another camera, with flipped PSFs.

    Example:
        >>> import tempfile
        >>> from kornia_tidy.data.dead_leaves import DeadLeaves
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     captures = NoiseFreeCaptures(DeadLeaves(2, 32, 32), TiDyOptics(fidelity="draft"), folder)
        ...     captures[1].light.shape, sorted(path.name for path in Path(folder).iterdir())
        (torch.Size([3, 32, 32]), ['000001.npy', 'captures.json'])
    """

    def __init__(
        self,
        scenes: Dataset[Any],
        optics: TiDyOptics,
        folder: str | os.PathLike[str],
        made_from: Mapping[str, Any] | None = None,
    ) -> None:
        self.scenes, self.folder = scenes, Path(folder)
        self.optics = copy.deepcopy(optics).requires_grad_(requires_grad=False)
        self.optics.sensor = None
        conditions = {"camera": camera_digest(self.optics, settings=True), "set of scenes": dict(made_from or {})}
        self.optics.color_space = "linear"
        self.decode = optics.decode
        self.folder.mkdir(parents=True, exist_ok=True)
        claim(self.folder, json.loads(json.dumps(conditions, default=str)), CONDITIONS)

    def __len__(self) -> int:
        """Return the number of scenes."""
        return len(cast("Any", self.scenes))

    def __getitem__(self, index: int) -> NoiseFreeCapture:
        """Return a capture and its true maps.

        Raises:
            ValueError: if the scene cannot be used, or its file is damaged.
        """
        path = self.folder / f"{index:06d}.npy"
        if not path.exists():
            planes = self._render(index)
            write_bytes(path, encode_npy(planes))
        else:
            with error_prefix(f"{path} is damaged, delete it to have it rendered again"):
                planes = decode_npy(read_bytes(path))
        values = torch.from_numpy(planes.astype(np.float32)) / LEVELS
        return NoiseFreeCapture(values[:3], values[3:6], values[6:7], values[7:] > 0)

    @torch.no_grad()
    def _render(self, index: int) -> np.ndarray:
        """Return capture, image, inverse depth and mask of a scene, (8, H, W) uint16."""
        with seeded(keyed_seed("scene", index)), repeatable():
            scene = self.scenes[index]
            image, depth = scene["image"][None], scene["depth"][None]
            mask = scene["mask"][None] if "mask" in scene else torch.ones_like(depth, dtype=torch.bool)
            sample = self.optics({"image": self.decode(image), "depth": depth, "mask": mask})
        inverse_depth = normalised_inverse_depth(self.optics.camera, sample["depth"])
        planes = torch.cat([sample["image"], sample["all_in_focus"], inverse_depth, sample["mask"].float()], 1)[0]
        return (planes.clamp(0, 1) * LEVELS).round().numpy().astype(np.uint16)
