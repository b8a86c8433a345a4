"""Reader of safetensors files, with checks against damaged and malicious content."""

from __future__ import annotations

import os

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load
from torch import Tensor

from kornia_tidy.files import check_file, read_bytes


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
        ValueError: if it is not a regular file, damaged, or of another format.

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
        if not path.stat().st_size:
            raise SafetensorError("the file is empty")
        with safe_open(path, framework="pt") as file:  # compares the header with the length, before anything is read
            header = dict(file.metadata() or {})
        # Not get_tensor: safetensors 0.8 keeps two integers for each tensor that it reads.
        found = load(read_bytes(path))
        return {name: found.pop(name).clone().to(device) for name in sorted(found)}, header
    except (SafetensorError, AttributeError, KeyError, TypeError) as error:  # KeyError: a data type that PyTorch lacks
        raise ValueError(f"cannot read {path}: it is no {what} or is damaged: {error!s:.300}") from None
