"""Reader of safetensors files, with checks against damaged and malicious content."""

from __future__ import annotations

import os

import torch
from safetensors import SafetensorError
from safetensors.torch import load
from torch import Tensor

from kornia_tidy.files import error_prefix, parse_json, read_bytes

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
    tensors, header = parse_tensors(read_bytes(path), f"cannot read {path}: it is no {what} or is damaged")
    return {name: tensors.pop(name).to(device) for name in list(tensors)}, header


def parse_tensors(
    data: bytes, fault: str = "it is no safetensors file or is damaged"
) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Return tensors by name and the metadata of a safetensors file that is in memory. See :func:`read_tensors`.

    Args:
        data: bytes of the file.
        fault: beginning of the message.

    Raises:
        ValueError: if it is damaged, or its header is longer than 16 MiB, which may be of so many tensors that they
            take gigabytes.

    Example:
        >>> from safetensors.torch import save
        >>> parse_tensors(save({"phase": torch.ones(2)}, {"of": "a mask"}))
        ({'phase': tensor([1., 1.])}, {'of': 'a mask'})
    """
    with error_prefix(fault, SafetensorError, AttributeError, KeyError, TypeError):  # KeyError: an unknown data type
        length = int.from_bytes(data[:8], "little")
        if length > LONGEST_HEADER:
            raise ValueError(f"its header must have at most {LONGEST_HEADER} bytes, got {length}")
        found = load(data)  # not safe_open's get_tensor: safetensors 0.8 keeps two integers for each tensor it reads
        header = parse_json(data[8 : 8 + length]).get("__metadata__") or {}
        return {name: found.pop(name).clone() for name in sorted(found)}, header
