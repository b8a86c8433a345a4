"""A camera's settings as one small tensor in its state: what shapes a capture besides the weights.

Modules are described by their class, their public attributes and their parts; dataclasses by their fields; tensors that
are neither parameters nor buffers by their values. Private attributes, parameters and buffers are left out.
"""

from __future__ import annotations

import base64
import hashlib
import json
import math
import zlib
from collections.abc import Mapping
from dataclasses import fields, is_dataclass, replace
from numbers import Integral, Real
from typing import Any

import torch
from torch import Tensor, nn

from kornia_tidy.files import parse_json
from kornia_tidy.optics.aperture import OpenArea

EXTRA_STATE = "_extra_state"  # how PyTorch calls the entry of a state that is neither parameter nor buffer
_PAGE = 4096  # bytes; settings of about the same length fill the same tensor, as distributed checkpoints want it
_MOST_VALUES = 1 << 16  # of a tensor written in full; of larger ones the digest is written
_WORDS = ("name", "source")  # fields that name a setting and change nothing
_NOT_SET = object()
_REMEDY = f"without its {EXTRA_STATE!r} entry only the weights of the state are loaded"


def settings_of(value: Any) -> Any:
    """Return the settings of a module, a dataclass or a plain value, as JSON holds them.

    Example:
        >>> from kornia_tidy.modulator.modulator import DwellTimes
        >>> settings_of(DwellTimes((3, 1)))
        {'is': 'DwellTimes', 'shares': [0.75, 0.25]}
    """
    if value is None or isinstance(value, (bool, str)):
        return value
    if isinstance(value, Real):
        return int(value) if isinstance(value, Integral) else float(value)
    if isinstance(value, nn.Module):
        own = {name: entry for name, entry in vars(value).items() if name[0] != "_" and name != "training"}
        return {"is": type(value).__name__, **_described(own), **_described(value._modules)}
    if is_dataclass(value) and not isinstance(value, type):
        return {"is": type(value).__name__, **_described({f.name: getattr(value, f.name) for f in fields(value)})}
    if isinstance(value, Tensor):
        return digest_of(value) if value.numel() > _MOST_VALUES or value.is_complex() else _packed(value)
    if isinstance(value, (tuple, list)):
        return [settings_of(entry) for entry in value]
    if isinstance(value, Mapping):
        return _described(value)
    return getattr(value, "__qualname__", type(value).__name__)  # functions by their names


def digest_of(*tensors: Tensor) -> str:
    """Return a text that tells tensors apart by their shapes and bytes."""
    digest = hashlib.sha256()
    for tensor in tensors:
        digest.update(repr((tuple(tensor.shape), tensor.dtype)).encode())
        digest.update(tensor.detach().cpu().contiguous().reshape(-1).view(torch.uint8).numpy().tobytes())
    return f"sha256 {digest.hexdigest()[:16]}"


def write_settings(settings: Mapping[str, Any]) -> Tensor:
    """Return settings as bytes, (n,) uint8 on the CPU; a check sum stands before them.

    Example:
        >>> read_settings(write_settings({"window": 65}))
        {'window': 65}
    """
    text = json.dumps(settings, separators=(",", ":")).encode()
    text = b"%08x" % zlib.crc32(text) + text
    return torch.frombuffer(bytearray(text.ljust(-(-len(text) // _PAGE) * _PAGE)), dtype=torch.uint8).clone()


def read_settings(stored: Any) -> dict[str, Any]:
    """Return the settings that :func:`write_settings` wrote.

    Raises:
        ValueError: if they are damaged, such as by averaging them with others.
    """
    try:
        if not isinstance(stored, Tensor) or stored.dtype != torch.uint8 or stored.ndim != 1:
            raise ValueError("they are not bytes")
        text = stored.cpu().numpy().tobytes().rstrip(b" ")
        if int(text[:8], 16) != zlib.crc32(text[8:]):
            raise ValueError("their check sum is wrong")
        settings = parse_json(text[8:])
        if not isinstance(settings, dict):
            raise ValueError("they have no names")
    except ValueError as error:
        raise ValueError(f"cannot read the camera's settings in the state: {error}; {_REMEDY}") from None
    return settings


def check_settings(saved: Mapping[str, Any], here: Mapping[str, Any]) -> None:
    """Raise ``ValueError`` where a saved camera and this one differ in a part that both have.

    Numbers that differ by a billionth are the same: processors round differently.

    Example:
        >>> check_settings({"border": "zero"}, {"border": "reflect"})  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ValueError: the state is that of another camera: border is 'zero' in the state and 'reflect' here; ...
    """
    for name in here:
        if name in saved and (found := _difference(saved[name], here[name], name)):
            place, there, own = found
            raise ValueError(
                f"the state is that of another camera: {place} is {_short(there)} in the state and {_short(own)} here; "
                f"make this camera like it, or take its settings over by load_state_dict(state, take_over=True); "
                f"{_REMEDY}"
            )


def take_over(owner: Any, saved: Mapping[str, Any], here: Mapping[str, Any], names: Mapping[str, str]) -> None:
    """Set the settings of a camera to those of a saved one.

    Args:
        owner: the camera. After an error some settings are set.
        saved: settings of the saved camera, by the names of the parts.
        here: those of this camera.
        names: the attribute of each part that can be set.

    Raises:
        ValueError: if a part is of another class than the saved one, or a setting cannot be made from a file.
    """
    for part in here:
        if part in saved and part in names:
            _take(owner, names[part], saved[part], part)
        elif part in saved and (found := _difference(saved[part], here[part], part)):
            raise ValueError(_no_way(*found))


def _described(values: Mapping[str, Any]) -> dict[str, Any]:
    return {str(name): settings_of(value) for name, value in values.items()}


def _packed(tensor: Tensor) -> dict[str, Any]:
    data = tensor.detach().cpu().double().contiguous().numpy().tobytes()  # apertures are mostly zeros and ones
    packed = {"is": "tensor", "shape": list(tensor.shape), "values": base64.b64encode(zlib.compress(data)).decode()}
    return {**packed, "open_area": True} if isinstance(tensor, OpenArea) else packed


def _unpacked(packed: Mapping[str, Any]) -> Tensor:
    shape, size = packed["shape"], 8 * math.prod(packed["shape"])
    if size > 8 * _MOST_VALUES:
        raise ValueError(f"a tensor of {shape} is too large for settings")
    data = zlib.decompressobj().decompress(base64.b64decode(packed["values"]), max(size, 1))
    tensor = (
        torch.frombuffer(bytearray(data), dtype=torch.float64).reshape(shape).clone() if size else torch.empty(shape)
    )
    return tensor.as_subclass(OpenArea) if packed.get("open_area") else tensor


def _difference(saved: Any, here: Any, place: str) -> tuple[str, Any, Any] | None:
    """Return the first place where settings differ, and both values there."""
    if isinstance(saved, dict) and isinstance(here, dict) and saved.get("is") == here.get("is"):
        if here.get("is") == "tensor":
            alike = saved == here or (
                saved["shape"] == here["shape"]
                and torch.allclose(_unpacked(saved), _unpacked(here), rtol=1e-9, atol=1e-15, equal_nan=True)
            )
            return None if alike else (place, saved, here)
        for name in dict.fromkeys([*here, *saved]):
            if name in _WORDS and "is" in here:
                continue
            found = _difference(saved.get(name, _NOT_SET), here.get(name, _NOT_SET), f"{place}.{name}")
            if found:
                return found
        return None
    if isinstance(saved, list) and isinstance(here, list) and len(saved) == len(here):
        for i, (one, other) in enumerate(zip(saved, here, strict=True)):
            if found := _difference(one, other, f"{place}[{i}]"):
                return found if len(saved) > 4 else (place, saved, here)
        return None
    return None if _same(saved, here) else (place, saved, here)


def _same(one: Any, other: Any) -> bool:
    if isinstance(one, (int, float)) and isinstance(other, (int, float)):
        whether = isinstance(one, bool) or isinstance(other, bool)
        close = math.isclose(one, other, rel_tol=1e-9, abs_tol=1e-15) or (one != one and other != other)  # noqa: PLR0124
        return one is other if whether else close
    return type(one) is type(other) and one == other and one is not _NOT_SET


def _short(value: Any) -> str:
    if isinstance(value, dict) and value.get("is") == "tensor":
        return f"a tensor of shape {tuple(value['shape'])} and check sum {zlib.crc32(value['values'].encode()):08x}"
    if isinstance(value, dict) and "is" in value:
        return f"a {value['is']}"
    text = "not set" if value is _NOT_SET else repr(value)
    return text if len(text) < 80 else f"{text[:76]} ..."


def _take(owner: Any, attribute: str, saved: Any, place: str) -> None:
    """Give a part its saved settings."""
    current = getattr(owner, attribute)
    here = settings_of(current)
    if not isinstance(current, nn.Module):
        if here != saved:
            setattr(owner, attribute, _made(current, saved, place))
        return
    if not isinstance(saved, dict) or saved.get("is") != here["is"] or saved.keys() != here.keys():
        raise ValueError(_no_way(place, saved, here))
    for name in saved:
        if name != "is":
            _take(current, name, saved[name], f"{place}.{name}")


def _made(current: Any, saved: Any, place: str) -> Any:
    """Return the value that has these settings, of the kind of the present one."""
    here = settings_of(current)
    if here == saved:
        return current
    if is_dataclass(current) and isinstance(saved, dict) and isinstance(here, dict) and saved.keys() == here.keys():
        values = {f.name: getattr(current, f.name) for f in fields(current) if f.init}
        return replace(current, **{n: _made(v, saved[n], f"{place}.{n}") for n, v in values.items()})  # type: ignore[type-var]
    if isinstance(saved, dict) and saved.get("is") == "tensor" and (current is None or isinstance(current, Tensor)):
        if current is None or saved.get("open_area"):
            return _unpacked(saved)
        # States of earlier versions do not tell open areas from amplitudes.
        return current if {**here, **saved} == here else _unpacked(saved).to(current)
    if isinstance(current, Tensor) and saved is None:
        return None
    number, text = isinstance(saved, (int, float)), isinstance(saved, str)
    if isinstance(current, bool) or isinstance(saved, bool):
        fits = isinstance(current, bool) and isinstance(saved, bool)
    elif isinstance(current, (int, float)):
        fits = number or saved is None
    elif isinstance(current, tuple):
        fits = isinstance(saved, list) or saved is None
    else:
        fits = text if isinstance(current, str) else current is None and not isinstance(saved, dict)
    if not fits:
        raise ValueError(_no_way(place, saved, here))
    return _tuples(saved)


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


def _no_way(place: str, saved: Any, here: Any) -> str:
    return (
        f"settings cannot be taken over: {place} is {_short(saved)} in the state and {_short(here)} here, and no state "
        f"makes one into the other: give this camera that part first"
    )
