"""Precision: devices without float64, such as Apple's mps, and roots with finite gradients."""

from __future__ import annotations

import torch
from torch import Tensor

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


def safe_sqrt(value: Tensor) -> Tensor:
    """Return the square root, with a gradient of zero instead of infinity at zero.

    Example:
        >>> x = torch.tensor([0.0, 4.0], requires_grad=True)
        >>> torch.autograd.grad(safe_sqrt(x).sum(), x)[0]
        tensor([0.0000, 0.2500])
    """
    zero = value == 0
    return torch.where(zero, 0, torch.where(zero, 1, value).sqrt())
