"""Encoding of a capture to the bytes of its files, and decoding of its maps."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kornia_tidy.data.image_files import encode_image
from kornia_tidy.data.npy import encode_npy
from kornia_tidy.data.stored import decode_stored
from kornia_tidy.training.coded_datasets.layout import Layout

ABOUT = "scene.json"


def encode_item(sample: Mapping[str, Any], clamped_pixels: int, layout: Layout) -> dict[str, bytes]:
    """Encode a capture; return the bytes of its files by name.

    Args:
        sample: the mapping that :class:`~kornia_tidy.TiDyOptics` returns, with ``"index"``, ``"name"`` and ``"mask"``.
        clamped_pixels: number of pixels beyond the camera's range of depth.
        layout: files of a capture.

    Example:
        >>> picture, one = torch.zeros(3, 2, 2), torch.ones(1, 2, 2)
        >>> sample = {"image": picture, "all_in_focus": picture, "depth": one, "mask": one, "index": 4, "name": "lamp"}
        >>> files = encode_item(sample, 0, Layout(beside=("depth",)))
        >>> list(files), files["scene.json"]
        (['coded.png', 'depth.npy', 'scene.json'], b'{"index": 4, "name": "lamp", "clamped_pixels": 0}')
    """
    maps = {"coded": sample["image"], "image": sample["all_in_focus"]}
    files = {}
    for name in layout.fields:
        if name == "depth":
            files["depth.npy"] = _encode_npy(sample["depth"])
        elif name == "mask":
            files["mask.png"] = encode_image(sample["mask"].float())
        elif layout.floats:
            files[f"{name}.npy"] = _encode_npy(maps[name])
        else:
            files[f"{name}.png"] = encode_image(maps[name], bits=16)
    about = {"index": sample["index"], "name": sample["name"], "clamped_pixels": clamped_pixels}
    return {**files, ABOUT: json.dumps(about).encode()}


def decode_map(name: str, data: bytes, path: str) -> Tensor:
    """Decode a map, (C, H, W), from the bytes of its file.

    Args:
        name: ``"coded"``, ``"image"``, ``"depth"`` or ``"mask"``.
        data: the bytes.
        path: of the file, for messages.

    Returns:
        bool for the mask, else float32.

    Raises:
        ValueError: if the bytes are damaged.
    """
    file = decode_stored(data, path)
    stored = file.values.transpose(2, 0, 1)
    if name == "mask":
        return torch.from_numpy(stored > 0)
    if stored.dtype.kind == "u":
        stored = stored.astype(np.float32) / np.float32(file.white or np.iinfo(stored.dtype).max)
    return torch.from_numpy(np.ascontiguousarray(stored, np.float32))


def _encode_npy(values: Tensor) -> bytes:
    """Encode (C, H, W) as an NPY file (H, W, C), or (H, W) for one channel."""
    rows = values.detach().float().cpu().numpy().transpose(1, 2, 0)
    return encode_npy(np.ascontiguousarray(rows[..., 0] if rows.shape[2] == 1 else rows))
