"""Lens files: a table and the lens's lengths as safetensors of some tens of kilobytes."""

from __future__ import annotations

import json
from collections.abc import Mapping

import torch
from safetensors.torch import save
from torch import Tensor

from kornia_tidy.checks import check_finite, check_positive
from kornia_tidy.files import parse_json
from kornia_tidy.optics.default_device import on_cpu
from kornia_tidy.optics.lens.lens_table import EXACT, LensTable
from kornia_tidy.optics.lens.made_lenses import LensParts

_FORMAT = "kornia_tidy.lens/1"
_SCALARS = ("focal_length", "f_number", "focus_distance", "residual")


@on_cpu
def lens_bytes(parts: LensParts) -> bytes:
    """Return a lens as a file: coefficients in float32, lengths in float64."""
    tensors = {name: part.float().contiguous() for name, part in parts.table.tensors().items()}
    tensors |= {name: getattr(parts.table, name) for name in EXACT}
    tensors["scalars"] = torch.tensor([getattr(parts, name) for name in _SCALARS], dtype=torch.float64)
    # One entry: safetensors writes several in any order, and equal lenses are equal files.
    return save(tensors, {_FORMAT: json.dumps({"name": parts.name, "source": parts.source})})


def lens_parts(tensors: Mapping[str, Tensor], notes: Mapping[str, str], path: str) -> LensParts:
    """Return a lens from the tensors and notes of a file.

    Args:
        tensors: of the file.
        notes: of its header.
        path: for messages.

    Raises:
        ValueError: if the file is not a lens, a value is NaN or infinite, or shapes do not fit.
    """
    names = {*LensTable.__dataclass_fields__, "scalars"}
    if _FORMAT not in notes or set(tensors) != names:
        raise ValueError(f"{path} is not a lens: it is {sorted(notes)!r:.60} with {sorted(tensors)!r:.200}")
    for name, value in tensors.items():
        if not value.is_floating_point():
            raise ValueError(f"cannot read {path}: {name} must be floating point, got {value.dtype}")
        check_finite(f"{name} of {path}", value if name != "scalars" else value[:2])
    try:
        scalars = tensors["scalars"]
        if tuple(scalars.shape) != (len(_SCALARS),):
            raise ValueError(f"scalars must have shape ({len(_SCALARS)},), got {tuple(scalars.shape)}")
        given = dict(zip(_SCALARS, scalars.double().tolist(), strict=True))
        for name in ("focal_length", "f_number"):
            check_positive(name, given[name])
        if not given["focus_distance"] > 0:
            raise ValueError(f"focus_distance must be positive metres, got {given['focus_distance']}")
        words = parse_json(notes[_FORMAT])
        if not isinstance(words, dict) or {type(words.get(name)) for name in ("name", "source")} != {str}:
            raise ValueError("it must have a name and a source")
        table = LensTable(**{name: value.double() for name, value in tensors.items() if name != "scalars"})
    except ValueError as error:
        raise ValueError(f"cannot read {path}: {error}") from None
    return LensParts(words["name"], words["source"], table=table, **given)
