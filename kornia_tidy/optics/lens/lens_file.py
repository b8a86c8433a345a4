"""Lens files: a table and the lens's lengths as safetensors of some tens of kilobytes."""

from __future__ import annotations

import json
from collections.abc import Mapping

import torch
from safetensors.torch import save
from torch import Tensor

from kornia_tidy.checks import check_finite, check_number, check_positive, described
from kornia_tidy.files import error_prefix, parse_json
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
    words = {"name": parts.name, "source": parts.source}
    moved = {"mask_shift": shift} if (shift := parts.table.mask_shift) else {}  # files of masks in the stop lack it
    return save(tensors, {_FORMAT: json.dumps({**words, **moved})})


def lens_parts(tensors: Mapping[str, Tensor], notes: Mapping[str, str], path: str) -> LensParts:
    """Return a lens from the tensors and notes of a file.

    Args:
        tensors: of the file.
        notes: of its header.
        path: for messages.

    Raises:
        ValueError: if the file is not a lens, a value is NaN or infinite, or shapes do not fit.
    """
    names = {*LensTable.__dataclass_fields__, "scalars"} - {"mask_shift"}
    if _FORMAT not in notes or set(tensors) != names:
        raise ValueError(f"{path} is not a lens: it is {sorted(notes)!r:.60} with {sorted(tensors)!r:.200}")
    for name, value in tensors.items():
        if not value.is_floating_point():
            raise ValueError(f"cannot read {path}: {name} must be floating point, got {value.dtype}")
        check_finite(f"{name} of {path}", value if name != "scalars" else value[:2])
    with error_prefix(f"cannot read {path}"):
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
        parts = {name: value.double() for name, value in tensors.items() if name != "scalars"}
        if tuple(parts["field"].shape) != (2,):
            raise ValueError(f"field must have shape (2,), got {tuple(parts['field'].shape)}")
        if type(shift := words.get("mask_shift", 0.0)) not in (int, float):
            raise ValueError(f"mask_shift must be a number, got {described(shift)}")
        check_mask_shift(shift, float(parts["field"][0]))
        table = LensTable(**parts, mask_shift=float(shift))
    return LensParts(words["name"], words["source"], table=table, **given)


def check_mask_shift(shift: float, field: float) -> None:
    """Raise an error unless masks off the stop stay on the light of a field.

    Args:
        shift: in stop radii per metre.
        field: largest height in metres.

    Raises:
        TypeError: if it is not a number.
        ValueError: if masks would move by more than a stop radius.
    """
    check_number("mask_shift", shift)
    if not abs(shift) * field <= 1:  # False for NaN too
        raise ValueError(
            f"mask_shift must move masks by at most one stop radius over the lens's field of {field:.4g} m, got "
            f"{shift:.4g} stop radii per metre: move the masks nearer to the stop, or make the lens for a smaller field"
        )
