"""Checkpoints in one safetensors file: tensors as tensors, all other values as JSON in its header, no pickle."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import save_file
from torch import Tensor

from kornia_tidy.files import error_prefix, parse_json, replacing
from kornia_tidy.reconstruction.eight_bits import EightBits
from kornia_tidy.tensor_files import read_tensors

FORMAT = "kornia_tidy state 1"
WHAT = "checkpoint of kornia_tidy"
_PLAIN = (str, bool, int, float, type(None))
_TENSOR, _TUPLE, _PAIRS = "$tensor", "$tuple", "$pairs"  # markers of types that JSON lacks
_SCALE = "$scale"  # of a tensor in eight bits


def write_state(path: str | os.PathLike[str], state: Mapping[str, Any]) -> None:
    """Write a nested state atomically: an existing file is replaced once the new one is complete on the disk.

    Args:
        path: of the file; an existing one is replaced.
        state: nested dictionaries, lists and tuples of tensors, numbers, strings, booleans and None. A tensor may be
            :class:`~kornia_tidy.reconstruction.eight_bits.EightBits`; it is read as float32.

    Raises:
        OSError: if it cannot be written, for example because the disk is full.
        TypeError: if it holds a value of another type; the message names its place.

    Example:
        >>> import tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_state(f"{folder}/a.safetensors", {"step": 3, "masks": [torch.ones(2)]})
        ...     read_state(f"{folder}/a.safetensors")
        {'step': 3, 'masks': [tensor([1., 1.])]}
    """
    tensors: dict[str, Tensor] = {}
    text = json.dumps(_encode(state, "", tensors))
    try:
        with replacing(path) as temporary:
            save_file(tensors, temporary, {"format": FORMAT, "state": text})
            with temporary.open("rb") as written:
                os.fsync(written.fileno())  # else a power cut could leave an incomplete file under the name
    except (OSError, SafetensorError) as error:
        kept = "; the one written before is intact" if Path(path).is_file() else ""
        told = error if isinstance(error, OSError) else f"cannot write {path}: {error}"
        raise OSError(f"{told}{kept}") from error


def read_state(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read a state that :func:`write_state` wrote, to the CPU. No code from the file is run.

    Raises:
        FileNotFoundError: if the file is missing.
        ValueError: if the file is damaged or of another format.

    Convention:
        Each tensor of the file stands in one place, so that the state takes little more memory than the file: those
        eight bits take four times theirs, and the header, of at most 16 MiB, up to 50 times.
    """
    tensors, header = read_tensors(path, WHAT)
    with error_prefix(f"cannot read {path}: it is no {WHAT} or is damaged", KeyError, TypeError):
        if header.get("format") != FORMAT:
            raise ValueError(f"its format is {header.get('format')!r}, not {FORMAT!r}")
        state = _decode(parse_json(header["state"]), dict(tensors))
        if not isinstance(state, dict):
            raise ValueError(f"its state is a {type(state).__name__}")
    return state


def _encode(value: Any, place: str, tensors: dict[str, Tensor]) -> Any:
    if isinstance(value, Tensor):
        name = place or "tensor"
        while name in tensors:  # "a/b" may be a key, or a key in another's value
            name += "'"
        # A copy, as safetensors refuses tensors that share memory, such as a view of another's.
        tensors[name] = value.detach().cpu().clone(memory_format=torch.contiguous_format)
        return {_TENSOR: name}
    if type(value) in _PLAIN:
        return value
    if isinstance(value, EightBits):
        scale = _encode(value.scale, f"{place}/{_SCALE}", tensors)
        return {**_encode(value.values, place, tensors), _SCALE: scale[_TENSOR]}
    if isinstance(value, Mapping):
        items = {key: _encode(entry, f"{place}/{key}", tensors) for key, entry in value.items()}
        if all(isinstance(key, str) and not key.startswith("$") for key in items):
            return items
        return {_PAIRS: [[_encode(key, f"a key of {place}", {}), entry] for key, entry in items.items()]}
    if isinstance(value, (list, tuple)):
        items = [_encode(entry, f"{place}/{i}", tensors) for i, entry in enumerate(value)]
        return {_TUPLE: items} if isinstance(value, tuple) else items
    raise TypeError(f"a state holds tensors, numbers, strings, None and containers of them: {place} is {type(value)}")


def _decode(value: Any, tensors: dict[str, Tensor | None]) -> Any:
    if isinstance(value, list):
        return [_decode(entry, tensors) for entry in value]
    if not isinstance(value, dict):
        return value
    if _SCALE in value:
        return _weight(EightBits(_taken(value[_TENSOR], tensors), _taken(value[_SCALE], tensors)))
    if _TENSOR in value:
        return _taken(value[_TENSOR], tensors)
    if _TUPLE in value:
        return tuple(_decode(entry, tensors) for entry in value[_TUPLE])
    if _PAIRS in value:
        return {key: _decode(entry, tensors) for key, entry in value[_PAIRS]}
    return {key: _decode(entry, tensors) for key, entry in value.items()}


def _taken(name: Any, tensors: dict[str, Tensor | None]) -> Tensor:
    """Take a tensor out of those of the file: each place has its own, so a file cannot unfold."""
    if name not in tensors:
        raise ValueError(f"there is no tensor {name!r:.80}")
    tensor, tensors[name] = tensors[name], None
    if tensor is None:
        raise ValueError(f"the tensor {name!r:.80} stands in two places")
    return tensor


def _weight(stored: EightBits) -> Tensor:
    shape = tuple(stored.values.shape)
    if tuple(stored.scale.shape) != (*shape[:1], *[1] * (len(shape) - 1)):
        raise ValueError(f"a scale of {tuple(stored.scale.shape)} does not fit a weight of {shape}")
    if (stored.values.dtype, stored.scale.dtype) != (torch.int8, torch.float32):
        raise ValueError(f"a weight in eight bits is {stored.values.dtype} with a scale of {stored.scale.dtype}")
    return stored.weight()
