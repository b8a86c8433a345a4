"""Decoding of the samples that WebDataset reads from shards of captures."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import PurePosixPath
from typing import Any

from kornia_tidy.data.scene_dataset import UnreadableItemError
from kornia_tidy.files import parse_json
from kornia_tidy.training.coded_datasets.item_files import ABOUT, decode_map
from kornia_tidy.training.coded_datasets.layout import BESIDE

MAPS = ("coded", *BESIDE)


def decode_sample(sample: Mapping[str, Any]) -> dict[str, Any]:
    """Decode a sample of WebDataset from a shard of captures, as :class:`CodedCaptures` returns it.

    One line reads shards: ``webdataset.WebDataset(shards, shardshuffle=False).map(decode_sample)``. WebDataset's own
    decoders would cut 16-bit PNG files to 8 bits, and leave depth without its axis of channels.

    Args:
        sample: bytes by the names of the files, such as ``"coded.png"``, with ``"__key__"`` and ``"__url__"``.

    Returns:
        ``{"coded", "image", "depth", "mask", "index", "name"}``, without the maps that were not stored. Images
        (3, H, W) float32, depth (1, H, W) float32 in metres, mask (1, H, W) bool. Other files of the sample are passed
        on unchanged; entries that begin with ``__`` are left out, and WebDataset adds ``"__key__"`` again.

    Raises:
        UnreadableItemError: if a file is damaged, or the sample is not a capture. ``map(decode_sample,
            handler=webdataset.warn_and_continue)`` skips it.

    Example:
        >>> import torch
        >>> from kornia_tidy.training.coded_datasets.item_files import encode_item
        >>> from kornia_tidy.training.coded_datasets.layout import Layout
        >>> picture, one = torch.rand(3, 4, 6), torch.ones(1, 4, 6)
        >>> item = {"image": picture, "all_in_focus": picture, "depth": one, "mask": one, "index": 7, "name": "lamp"}
        >>> files = encode_item(item, 0, Layout(beside=("depth",)))
        >>> found = decode_sample({"__key__": "000007", "__url__": "00000.tar", **files})
        >>> {name: getattr(value, "shape", value) for name, value in found.items()}
        {'coded': torch.Size([3, 4, 6]), 'depth': torch.Size([1, 4, 6]), 'index': 7, 'name': 'lamp'}
    """
    place = f"{sample.get('__url__', 'a shard')}, capture {sample.get('__key__', 'without key')}"
    try:
        about = parse_json(sample[ABOUT])
        own = {"index": int(about["index"]), "name": str(about["name"])}
    except (KeyError, OverflowError, TypeError, ValueError) as error:
        raise UnreadableItemError(f"cannot read {place}: it has no {ABOUT} of a capture, or it is damaged") from error
    decoded: dict[str, Any] = {}
    for file, data in sample.items():
        name = PurePosixPath(file).stem
        if file.startswith("__") or file == ABOUT:
            continue
        try:
            decoded[name if name in MAPS else file] = (
                decode_map(name, data, f"{place}, {file}") if name in MAPS else data
            )
        except ValueError as error:
            raise UnreadableItemError(str(error)) from error
    if "coded" not in decoded:
        raise UnreadableItemError(f"cannot read {place}: it has no coded image, only {', '.join(sorted(sample))}")
    return {**decoded, **own}
