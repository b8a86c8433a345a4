"""Gauss-Legendre quadrature: nodes and weights for integrals over one pupil cell, and the order that a phase needs."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor


def gauss_legendre_order(half_range: float, tolerance: float) -> int:
    r"""Return the number of Gauss-Legendre points that integrate a linear phase over an interval within a tolerance.

    The integrand is :math:`e^{i b t}` over t in [-1, 1], for every |b| <= half_range.

    Args:
        half_range: largest phase b in radians, from the middle of the interval to its edge.
        tolerance: largest error allowed in the mean over the interval.

    Returns:
        The order of the quadrature. Above 32 it grows in steps of an eighth, so it may exceed the least sufficient one.

    Raises:
        ValueError: if ``half_range`` is NaN or infinite.

    Source: Abramowitz and Stegun, Handbook of Mathematical Functions, section 25.4.29.

    Example:
        >>> gauss_legendre_order(1.2, 1e-3), gauss_legendre_order(6.0, 1e-7)
        (3, 9)
    """
    if not math.isfinite(half_range):  # the search below would never end
        raise ValueError(f"a phase across an interval must be finite radians, got {half_range}")
    b = np.linspace(0, half_range, 33)
    exact = np.sinc(b / np.pi)
    order = 1
    while True:
        nodes, weights = _leggauss(order)
        if np.abs(np.cos(b[:, None] * nodes) @ weights / 2 - exact).max() <= tolerance:
            return order
        order += 1 if order < 32 else order // 8


def gauss_legendre(order: int, device: torch.device | None = None) -> tuple[Tensor, Tensor]:
    """Return the Gauss-Legendre nodes on [-1/2, 1/2] and their weights, which sum to one.

    Args:
        order: number of nodes.
        device: device of the result.

    Returns:
        Nodes and weights, (order,) float64 each.

    Example:
        >>> gauss_legendre(1)
        (tensor([0.], dtype=torch.float64), tensor([1.], dtype=torch.float64))
    """
    nodes, weights = torch.tensor(_gauss_legendre(order), dtype=torch.float64, device=device)
    return nodes, weights


def _gauss_legendre(order: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
    nodes, weights = _leggauss(order)
    return tuple((nodes / 2).tolist()), tuple((weights / 2).tolist())


@lru_cache(maxsize=64)  # a search tries one order after the other, and a large one takes milliseconds
def _leggauss(order: int) -> tuple[np.ndarray, np.ndarray]:
    return np.polynomial.legendre.leggauss(order)


# torch.compile cannot trace NumPy, so the results are marked as constants. torch.compiler.assume_constant_result sets
# the same mark but imports the compiler, which takes 2 s.
for _function in (gauss_legendre_order, _gauss_legendre):
    setattr(_function, "_dynamo_marked_constant", True)  # noqa: B010 (a function has no such attribute to a checker)
