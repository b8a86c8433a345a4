"""Reader of safetensors files, with checks against damaged and malicious content."""

from __future__ import annotations

import os
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load
from torch import Tensor

from kornia_tidy.files import check_file, parse_json, read_bytes

LONGEST_HEADER = 1 << 24  # bytes


def read_tensors(
    path: str | os.PathLike[str], what: str = "safetensors file", device: torch.device | str = "cpu"
) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Read a safetensors file.

    Args:
        path: the file.
        what: description of the expected file, for the message.
        device: of the tensors.

    Returns:
        Tensors by name, copied from the file, and the metadata of its header by name.

    Raises:
        FileNotFoundError: if the file is missing.
        ValueError: if it is not a regular file, damaged, of another format, or its header is longer than 16 MiB.

    Example:
        >>> import tempfile
        >>> from safetensors.torch import save_file
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_file({"phase": torch.ones(2)}, f"{folder}/a.safetensors", {"of": "a mask"})
        ...     read_tensors(f"{folder}/a.safetensors")
        ({'phase': tensor([1., 1.])}, {'of': 'a mask'})
    """
    path = check_file(path)
    try:
        _check_header(path)
        with safe_open(path, framework="pt") as file:  # compares the header with the length, before anything is read
            header = dict(file.metadata() or {})
        # Not get_tensor: safetensors 0.8 keeps two integers for each tensor that it reads.
        found = load(read_bytes(path))
        return {name: found.pop(name).clone().to(device) for name in sorted(found)}, header
    except (SafetensorError, AttributeError, KeyError, TypeError) as error:  # KeyError: a data type that PyTorch lacks
        raise ValueError(f"cannot read {path}: it is no {what} or is damaged: {error!s:.300}") from None


def parse_tensors(data: bytes, what: str = "safetensors file") -> tuple[dict[str, Tensor], dict[str, str]]:
    """Return tensors by name and the metadata of a safetensors file that is in memory. See :func:`read_tensors`.

    Args:
        data: bytes of the file.
        what: description of it, for the message.

    Raises:
        ValueError: if it is damaged, or its header is longer than 16 MiB.

    Example:
        >>> from safetensors.torch import save
        >>> parse_tensors(save({"phase": torch.ones(2)}, {"of": "a mask"}))
        ({'phase': tensor([1., 1.])}, {'of': 'a mask'})
    """
    try:
        length = int.from_bytes(data[:8], "little")
        if len(data) < 8 or length > LONGEST_HEADER:
            raise SafetensorError(f"its header must have at most {LONGEST_HEADER} bytes, got {length}")
        found = load(data)
        header = parse_json(data[8 : 8 + length]).get("__metadata__") or {}
        return {name: found.pop(name).clone() for name in sorted(found)}, header
    except (SafetensorError, AttributeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"cannot read {what}: it is damaged: {error!s:.300}") from None


def _check_header(path: Path) -> None:
    """Raise ``SafetensorError`` for an empty file, or a header of so many tensors that they take gigabytes."""
    with path.open("rb") as file:
        start = file.read(8)
    if not start:
        raise SafetensorError("the file is empty")
    if (length := int.from_bytes(start, "little")) > LONGEST_HEADER:
        raise SafetensorError(f"its header must have at most {LONGEST_HEADER} bytes, got {length}")
