"""One capture as the bytes of its files, and the maps in them again."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kornia_tidy.coded_datasets.layout import Layout
from kornia_tidy.data.image_files import encode_image
from kornia_tidy.data.stored import decode_stored

ABOUT = "scene.json"


def encode_item(sample: Mapping[str, Any], clamped_pixels: int, layout: Layout) -> dict[str, bytes]:
    """Return the files of a capture by name.

    Args:
        sample: what :class:`~kornia_tidy.TiDyOptics` makes of a mapping, with ``"index"``, ``"name"`` and ``"mask"``.
        clamped_pixels: how many of its pixels lay beyond the camera's range.
        layout: which files.

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
    """Return a map, (C, H, W), from the bytes of its file.

    Args:
        name: ``"coded"``, ``"image"``, ``"depth"`` or ``"mask"``.
        data: the bytes.
        path: how messages call them.

    Returns:
        bool for the mask, else float32.

    Raises:
        ValueError: if they are damaged.
    """
    stored = decode_stored(data, path).transpose(2, 0, 1)
    if name == "mask":
        return torch.from_numpy(stored > 0)
    if stored.dtype.kind == "u":
        stored = stored.astype(np.float32) / np.float32(np.iinfo(stored.dtype).max)
    return torch.from_numpy(np.ascontiguousarray(stored, np.float32))


def _encode_npy(values: Tensor) -> bytes:
    """Rows, columns and, if there are several, channels."""
    rows = values.detach().float().cpu().numpy().transpose(1, 2, 0)
    data = io.BytesIO()
    np.save(data, np.ascontiguousarray(rows[..., 0] if rows.shape[2] == 1 else rows), allow_pickle=False)
    return data.getvalue()
