"""Precision of devices: Apple's mps has no float64, and some graphics processors of Intel have none either."""

from __future__ import annotations

import torch

WITHOUT_FLOAT64 = {"mps"}  # types of devices


def has_float64(device: torch.device) -> bool:
    """Return whether a device computes in double precision.

    Example:
        >>> has_float64(torch.device("cpu")), has_float64(torch.device("mps"))
        (True, False)
    """
    if device.type == "xpu" and torch.xpu.is_available():
        return bool(torch.xpu.get_device_properties(device).has_fp64)
    return device.type not in WITHOUT_FLOAT64


def widest(device: torch.device) -> torch.dtype:
    """Return the widest real type of a device: float64, or float32.

    Example:
        >>> widest(torch.device("cpu")), widest(torch.device("mps"))
        (torch.float64, torch.float32)
    """
    return torch.float64 if has_float64(device) else torch.float32
