"""Reader of safetensors files, with checks against damaged and malicious content."""

from __future__ import annotations

import os
from pathlib import Path

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load
from torch import Tensor

from kornia_tidy.files import check_file, read_bytes

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
        FileNotFoundError: if there is no such file.
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


def _check_header(path: Path) -> None:
    """Raise ``SafetensorError`` for an empty file, or a header of so many tensors that they take gigabytes."""
    with path.open("rb") as file:
        start = file.read(8)
    if not start:
        raise SafetensorError("the file is empty")
    if (length := int.from_bytes(start, "little")) > LONGEST_HEADER:
        raise SafetensorError(f"its header must have at most {LONGEST_HEADER} bytes, got {length}")
