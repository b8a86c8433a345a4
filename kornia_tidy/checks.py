"""Checks of what users pass in: each raises one sentence that names the value and what is allowed.

They are plain raises, so ``python -O`` keeps them. Checks that look at values (and so wait for the device)
are separate from those that look at shapes and types.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import torch
from torch import Tensor


def check_choice(name: str, value: Any, allowed: Collection[Any]) -> None:
    """Raise ``ValueError`` unless ``value`` is one of ``allowed``."""
    if value not in allowed:
        raise ValueError(f"{name} must be one of {', '.join(map(repr, allowed))}, got {value!r}")


def check_positive(name: str, value: float, unit: str = "") -> None:
    """Raise ``ValueError`` unless ``value`` is a finite number above zero."""
    if not 0 < value < float("inf"):
        raise ValueError(f"{name} must be positive and finite{' ' + unit if unit else ''}, got {value}")


def check_float_tensor(name: str, value: Any, rank: int, layout: str) -> None:
    """Raise ``TypeError`` unless ``value`` is a floating-point tensor, ``ValueError`` unless it has this rank."""
    if not isinstance(value, Tensor):
        raise TypeError(f"{name} must be a torch.Tensor, got {type(value).__name__}")
    if not value.is_floating_point():
        raise TypeError(f"{name} must be floating point with values in [0, 1] or metres, got {value.dtype}")
    if value.ndim != rank:
        raise ValueError(f"{name} must have shape {layout}, got {tuple(value.shape)}")


def check_finite(name: str, value: Tensor) -> None:
    """Raise ``ValueError`` if a value is NaN or infinite. Waits for the device."""
    if not value.numel():
        return
    lowest, highest = torch.aminmax(value.detach())  # NaN if any value is: one pass, and no map of truths
    if not bool(lowest.isfinite() & highest.isfinite()):
        bad = value[~torch.isfinite(value)][0].item()
        raise ValueError(f"{name} must be finite, got {bad}")


def check_depth(depth: Tensor) -> None:
    """Raise ``ValueError`` if a depth is NaN, zero or negative; infinity is allowed. Waits for the device."""
    if depth.numel() and not bool(depth.detach().amin() > 0):  # False for NaN too
        bad = depth[~(depth > 0)][0].item()
        raise ValueError(f"depth must be positive metres, got {bad} (fill holes and mark them in a mask first)")
