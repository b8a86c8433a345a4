"""Argument checks: each raises an error of one sentence that names the value and the allowed ones.

They raise explicitly, so that ``python -O`` keeps them. Checks of tensor values, which wait for the device, are
separate from checks of shapes and types.
"""

from __future__ import annotations

import math
import operator
import sys
from collections.abc import Collection
from numbers import Integral
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:  # settings check their values too, and a command's help does not wait for torch
    from torch import Tensor


def check_choice(name: str, value: Any, allowed: Collection[Any]) -> None:
    """Raise ``ValueError`` unless ``value`` is one of ``allowed``."""
    if value not in allowed:
        text = repr(value)  # a damaged file can make it arbitrarily long
        got = text if len(text) <= 80 else f"{text[:76]} ..."
        raise ValueError(f"{name} must be one of {', '.join(map(repr, allowed))}, got {got}")


def check_positive(name: str, value: float, unit: str = "") -> None:
    """Raise ``ValueError`` unless ``value`` is positive and finite, ``TypeError`` if it is not a number."""
    check_number(name, value, unit)
    if not 0 < value < float("inf"):
        raise ValueError(f"{name} must be positive and finite{' ' + unit if unit else ''}, got {value}")


def check_not_negative(name: str, value: float, unit: str = "") -> None:
    """Raise ``ValueError`` unless ``value`` is zero or positive and finite, ``TypeError`` if it is not a number."""
    check_number(name, value, unit)
    if not 0 <= value < float("inf"):
        raise ValueError(f"{name} must be zero or positive and finite{', ' + unit if unit else ''}, got {value}")


def check_number(name: str, value: Any, unit: str = "") -> None:
    """Raise ``TypeError`` unless ``value`` is a single number; NumPy's arrays with axes are none."""
    shape = getattr(value, "shape", ())
    axes = math.prod(shape) != 1 or (shape and not hasattr(value, "requires_grad"))
    if isinstance(value, str) or not hasattr(value, "__float__") or axes:
        raise TypeError(
            f"{name} must be a number{' in ' + unit.removeprefix('in ') if unit else ''}, got {described(value)}"
        )


def check_count(name: str, value: int, least: int = 1, most: int | None = None) -> None:
    """Raise ``ValueError`` unless ``value`` is a whole number of at least ``least`` and at most ``most``."""
    if not isinstance(value, Integral) or value < least or (most is not None and value > most):
        allowed = f"of at least {least}" if most is None else f"from {least} to {most}"
        raise ValueError(f"{name} must be a whole number {allowed}, got {value!r}")


def check_metres(name: str, value: float, shortest: float, longest: float, example: str) -> None:
    """Raise ``ValueError`` unless a length in metres lies within plausible limits; ``example`` is a valid value."""
    check_positive(name, value, "metres")
    if not shortest <= value <= longest:
        raise ValueError(f"{name} must be metres between {shortest:g} and {longest:g} ({example}), got {value}")


def check_part(name: str, value: Any, kind: type | tuple[type, ...], example: str, needs: str = "") -> None:
    """Raise ``TypeError`` unless ``value`` has a type and, if given, an attribute.

    Example:
        >>> import torch
        >>> check_part("masks", 5, torch.nn.Module, "phase masks such as PixelwiseMask(5)")
        Traceback (most recent call last):
        TypeError: masks must be phase masks such as PixelwiseMask(5), got the number 5
    """
    if not isinstance(value, kind) or (needs and not hasattr(type(value), needs)):
        raise TypeError(f"{name} must be {example}, got {described(value)}")


def unmasked(name: str, value: Any) -> Any:
    """Return a masked array of NumPy as a plain one, and anything else unchanged.

    Raises:
        ValueError: if a value is masked.

    Example:
        >>> import numpy as np
        >>> unmasked("image", np.ma.masked_equal([[3, 9]], 9))
        Traceback (most recent call last):
        ValueError: image must be known at every pixel, and 1 of its 2 values are masked: fill them first, such as \
with image.filled(0)
    """
    np = sys.modules.get("numpy")
    if np is None or not isinstance(value, np.ma.MaskedArray):
        return value
    if masked := np.ma.count_masked(value):
        raise ValueError(
            f"{name} must be known at every pixel, and {masked} of its {value.size} values are masked: fill them "
            f"first, such as with {name}.filled(0)"
        )
    return value.data


def check_generator(generator: Any) -> None:
    """Raise ``TypeError`` unless ``generator`` is None or a torch.Generator."""
    import torch  # noqa: PLC0415

    if generator is not None and not isinstance(generator, torch.Generator):
        seed = generator if type(generator) is int else 0
        raise TypeError(
            f"generator must be a torch.Generator such as torch.Generator().manual_seed({seed}), got "
            f"{described(generator)}"
        )


def checked_seed(seed: Any) -> int:
    """Return a seed as a plain integer, or raise ``TypeError`` unless it is a whole number of Python or NumPy."""
    try:
        return operator.index(seed)
    except TypeError:
        raise TypeError(f"seed must be a whole number, got {described(seed)}") from None


def described(value: Any) -> str:
    """Return a short description of a value for a message."""
    if isinstance(value, bool) or value is None:
        return repr(value)
    if isinstance(value, (int, float)):
        return f"the number {value}"
    return repr(value) if isinstance(value, str) and len(value) < 40 else f"a {type(value).__name__}"


def printed(value: Tensor, digits: int = 3) -> str:
    """Return the numbers of a tensor in short, for the description of a module; the meta device has none.

    Example:
        >>> import torch
        >>> printed(torch.tensor(0.0301)), printed(torch.tensor([0.5, 0.25])), printed(torch.ones(2, device="meta"))
        ('0.0301', '(0.5, 0.25)', 'unset')
    """
    if value.is_meta:
        return "unset"
    numbers = [f"{number:.{digits}g}" for number in value.detach().flatten().tolist()]
    return f"({', '.join(numbers)})" if value.ndim else numbers[0]


def check_float_tensor(name: str, value: Any, rank: int, layout: str) -> None:
    """Raise ``TypeError`` unless ``value`` is a floating-point tensor, ``ValueError`` unless it has this rank."""
    import torch  # noqa: PLC0415

    if not isinstance(value, torch.Tensor):
        remedy = ": torch.from_numpy makes one" if type(value).__name__ == "ndarray" else ""
        raise TypeError(f"{name} must be a torch.Tensor, got {type(value).__name__}{remedy}")
    if value.layout != torch.strided or value.is_nested:
        layout = "nested" if value.is_nested else value.layout
        raise TypeError(f"{name} must be a dense tensor, got a {layout} one: convert it, as to_dense() does")
    if type(value).__name__ == "MaskedTensor":
        raise TypeError(f"{name} must be a plain tensor, got a MaskedTensor: fill it, such as with {name}.to_tensor(0)")
    if value.is_floating_point() and value.element_size() < 2:
        raise TypeError(f"{name} must have 16 bits or more, got {value.dtype}: convert it with {name}.float()")
    if not value.is_floating_point():
        unit = {"depth": " in metres", "image": " with values in [0, 1]"}.get(name.removesuffix("s"), "")
        raise TypeError(f"{name} must be floating point{unit}, got {value.dtype}{_as_float(name, value)}")
    if value.is_meta:
        check_values(name, value)
    if value.ndim != rank:
        missing = name == "depth" and value.ndim == rank - 1
        remedy = f": add the axis of channels with depth.unsqueeze({-3})" if missing else ""
        raise ValueError(f"{name} must have shape {layout}, got {tuple(value.shape)}{remedy}")


def check_values(name: str, value: Tensor) -> None:
    """Raise ``ValueError`` if a tensor is on the meta device, where it has a shape and no values."""
    if value.is_meta:
        raise ValueError(
            f"{name} must hold values, and tensors on the meta device have none: move it to another device, and call "
            f"torch.set_default_device('cpu') if that is where new tensors are made"
        )


def _as_float(name: str, value: Tensor) -> str:
    """Return the hint for converting an integer tensor to floating point."""
    if name.startswith("depth"):
        return f": convert it with {name}.float() * 0.001 if it is in millimetres"
    import torch  # noqa: PLC0415

    if name.startswith("image") and value.dtype not in (torch.bool, torch.complex64, torch.complex128):
        return f": convert it with {name}.float() / {255 if value.dtype == torch.uint8 else 65535}"
    return ""


def check_finite(name: str, value: Tensor) -> None:
    """Raise ``ValueError`` if a value is not finite, ``TypeError`` if complex or of 8 bits. Waits for the device."""
    import torch  # noqa: PLC0415

    if value.is_complex() or (value.is_floating_point() and value.element_size() < 2):
        raise TypeError(f"{name} must be real numbers of 16 bits or more, got {value.dtype}")
    if not value.numel():
        return
    check_values(name, value)
    lowest, highest = torch.aminmax(value.detach())  # NaN if any value is: one pass without a boolean tensor
    if not bool(lowest.isfinite() & highest.isfinite()):
        bad = value[~torch.isfinite(value)][0].item()
        raise ValueError(f"{name} must be finite, got {bad}")


def check_depth(depth: Tensor) -> None:
    """Raise ``ValueError`` if a depth is NaN, zero or negative; infinity is allowed. Waits for the device."""
    check_values("depth", depth)
    if depth.numel() and not bool(depth.detach().amin() > 0):  # False for NaN too
        bad = depth[~(depth > 0)][0].item()
        raise ValueError(
            f"depth must be positive metres, got {bad}: fill holes with "
            f"depth, valid = kornia_tidy.data.fill_holes(depth), or give the camera holes='fill'"
        )
