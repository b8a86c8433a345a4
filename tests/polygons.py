"""Apertures that are regular polygons: shapes that turn and mirror visibly."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def polygon_aperture(size: int, pitch: float, sides: int, rotation: float = 0.0) -> Tensor:
    """Return the cells with centres in a polygon of radius 1, with its first corner at ``rotation`` from +x."""
    x = (torch.arange(size, dtype=torch.float64) - (size - 1) / 2) * pitch
    normals = [rotation + (2 * k + 1) * math.pi / sides for k in range(sides)]
    reach = torch.stack([x * math.cos(normal) + x[:, None] * math.sin(normal) for normal in normals]).amax(0)
    return (reach <= math.cos(math.pi / sides) + 1e-9).double()
