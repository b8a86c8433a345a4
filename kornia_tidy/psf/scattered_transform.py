r"""Fourier transform of scattered points to the light in the pixels of a sensor.

.. math:: I(p) = \int_p \Big| \sum_j c_j e^{-2\pi i (\nu_j X + \mu_j Y)} \Big|^2 dX \, dY

The points are spread on a grid with a kernel of a few samples, transformed by FFT, and the kernel's transform is
divided out: a nonuniform FFT of type 1. The samples of the intensity lie denser than its bandwidth asks, so that the
integral over a pixel is a short sum of them.

Source: Barnett, Magland and af Klinteberg, SIAM J. Sci. Comput. 41(5) C479 (2019), for the kernel; Kaiser's window for
the interpolation between samples.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from kornia_tidy.kernels.window_sides import next_fast_size

_SIGMA = 1.6  # period of the transform over the window: light beyond it folds back outside the used part
_DENSITY = 1.5  # samples of the intensity over those that its bandwidth needs
_NODES = 48


@dataclass(frozen=True, eq=False)
class Axis:
    """One axis of the transform.

    Args:
        start: first sample of the grid that each patch of points touches, (C,).
        kernel: weights of each point on the samples of its patch, (C, S, T).
        extent: samples of the grid that points touch.
        size: samples of the transform, the grid's first.
        correction: of the transform at the samples kept, (N,): one over the kernel's transform.
        pixels: sums over samples that give the light in pixels, one for each shift, (V, P, N).
    """

    start: Tensor
    kernel: Tensor
    extent: int
    size: int
    correction: Tensor
    pixels: Tensor

    def to(self, device: torch.device) -> Axis:
        """Return the axis on a device."""
        parts = (self.start, self.kernel, self.correction, self.pixels)
        start, kernel, correction, pixels = (part.to(device) for part in parts)
        return replace(self, start=start, kernel=kernel, correction=correction, pixels=pixels)


def scattered_axis(
    frequency: Tensor, window: int, tolerance: float, dtype: torch.dtype, shifts: Sequence[float] = (0.0,)
) -> Axis:
    """Return one axis of the transform of points.

    Args:
        frequency: of the points in cycles per pixel, (C, S) float64; those of a patch lie close together.
        window: side P in pixels, odd.
        tolerance: error of the field, relative to the sum of the points' moduli.
        dtype: float32 or float64 of the matrices.
        shifts: of the light in pixels, one for each copy of the PSFs.

    Example:
        >>> axis = scattered_axis(torch.linspace(-0.4, 0.4, 64, dtype=torch.float64)[:, None], 9, 1e-6, torch.float64)
        >>> axis.pixels.shape[0], axis.size
        (1, 90)
    """
    low, span = float(frequency.min()), max(float(frequency.max() - frequency.min()), 1e-3)
    width = max(3, math.ceil(-math.log10(tolerance) * _WIDTH) + 1)
    decay = -math.log(tolerance) + 1
    reach = math.ceil(math.hypot(decay, math.pi) / (math.pi * (1 - 1 / _DENSITY)))
    finest = 1 / (2 * _DENSITY * span)  # pixels between samples of the intensity, at most
    most = max(abs(shift) for shift in shifts)
    furthest = window / 2 + most + (reach + 1) * finest
    step = 1 / (2 * _SIGMA * furthest)  # cycles per pixel between samples of the grid
    size = next_fast_size(max(math.ceil(1 / (step * finest)), math.ceil(span / step) + width + 2))
    place = (frequency - low) / step + width / 2  # of the points, in samples
    start = torch.ceil(place.amin(1) - width / 2).long()
    patch = int((torch.floor(place.amax(1) + width / 2).long() - start).max()) + 1
    away = (start[:, None] + torch.arange(patch))[:, None] - place[..., None]
    kernel = _spread(2 * away / width, width)
    sample = 1 / (size * step)  # pixels
    count = min(math.floor((window / 2 + most) / sample) + reach + 1, size // 2 - 1)
    at = np.arange(-count, count + 1)
    edges = np.arange(window + 1) - window / 2 - np.array(shifts)[:, None]
    sums = sample * np.diff(_interpolant_integral(edges[..., None] / sample - at, reach, decay), axis=1)
    correction = 1 / _spread_transform(at / size, width)
    matrices = (torch.from_numpy(part).to(dtype) for part in (correction, sums))
    return Axis(start, kernel.to(dtype), int(start.max()) + patch, size, *matrices)


def scattered_energies(waves: Tensor, weights: Tensor, patches: Tensor, rows: Axis, columns: Axis) -> Tensor:
    """Return the light in each pixel, averaged over states, for each shift, (D, V, P, P).

    Args:
        waves: of each state and patch, (K, C) complex.
        weights: share of the exposure of each state, (K,).
        patches: fields of patches of unit amplitude on their samples of the grid, (D, C, T, T) complex.
        rows: axis y.
        columns: axis x.
    """
    tall, wide = patches.shape[-2:]
    down, across = (torch.arange(side, device=patches.device) for side in (tall, wide))
    index = (rows.start[:, None] + down)[:, :, None] * columns.extent + (columns.start[:, None] + across)[:, None]
    shape, index, found = (rows.extent, columns.extent), index.flatten(), []
    for patch in patches:
        flat = (waves[:, :, None, None] * patch).flatten(1)
        grid = flat.new_zeros(len(waves), shape[0] * shape[1]).index_add(1, index, flat).unflatten(1, shape)
        field = _transformed(_transformed(grid, columns, -1), rows, -2)
        light = torch.einsum("k,kyx->yx", weights, field.real.square() + field.imag.square())
        found.append(rows.pixels @ light @ columns.pixels.transpose(1, 2))
    return torch.stack(found)


def patches_of(field: Tensor, rows: Axis, columns: Axis) -> Tensor:
    """Return points spread on the grid, patch by patch: (D, C, S) complex to (D, C, T, T)."""
    down = rows.kernel.transpose(1, 2)
    real, imaginary = (  # depth by depth, so that none is rounded by how many they are
        torch.stack([down @ (own[..., None] * columns.kernel) for own in part]) for part in (field.real, field.imag)
    )
    return torch.complex(real, imaginary)


def _transformed(grid: Tensor, axis: Axis, dim: int) -> Tensor:
    """Return the samples of a transform that lie in the window, in order, without the kernel's decline."""
    count = len(axis.correction) // 2
    field = torch.fft.fft(grid, axis.size, dim=dim)
    kept = torch.cat([field.narrow(dim, axis.size - count, count), field.narrow(dim, 0, count + 1)], dim)
    return kept * (axis.correction if dim == -1 else axis.correction[:, None])


_WIDTH = 1.0 / (1 - 1 / (2 * _SIGMA)) / 2 * 1.5


def _shape(width: int) -> float:
    return 0.97 * math.pi * width * (1 - 1 / (2 * _SIGMA))


def _spread(at: Tensor, width: int) -> Tensor:
    """Return the exponential of a semicircle over [-1, 1]."""
    inside = (1 - at.square()).clamp(min=0)
    return torch.where(at.abs() <= 1, torch.exp(_shape(width) * (inside.sqrt() - 1)), 0.0)


@lru_cache(maxsize=4)
def _legendre(order: int) -> tuple[np.ndarray, np.ndarray]:
    return np.polynomial.legendre.leggauss(order)


def _spread_transform(frequency: np.ndarray, width: int) -> np.ndarray:
    """Return the Fourier transform of the kernel, frequency in cycles per sample."""
    nodes, weights = _legendre(2 * _NODES)
    values = weights * np.exp(_shape(width) * (np.sqrt(1 - nodes**2) - 1)) * width / 2
    return np.cos(math.pi * width * frequency[:, None] * nodes) @ values


@lru_cache(maxsize=16)
def _integral_table(reach: int, decay: float) -> np.ndarray:
    """Return the integral of the windowed sinc from 0 to steps of a thousandth of a sample."""
    nodes, weights = np.polynomial.legendre.leggauss(4)
    at = (np.arange(1000 * reach)[:, None] + (nodes + 1) / 2) / 1000
    window = np.i0(decay * np.sqrt(np.maximum(1 - (at / reach) ** 2, 0))) / np.i0(decay)
    return np.concatenate([[0.0], np.cumsum((np.sinc(at) * window) @ weights / 2000)])


def _interpolant_integral(at: np.ndarray, reach: int, decay: float) -> np.ndarray:
    """Return the integral of the interpolant between samples from 0 to ``at``, in samples."""
    table = _integral_table(reach, round(decay, 6))
    place = np.minimum(np.abs(at), reach) * 1000
    index = np.minimum(place.astype(int), len(table) - 2)
    part = place - index
    return np.sign(at) * (table[index] * (1 - part) + table[index + 1] * part)
