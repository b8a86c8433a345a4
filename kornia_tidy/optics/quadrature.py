"""Gauss-Legendre quadrature: nodes and weights for integrals over one pupil cell, and the order that a phase needs."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

_SPREADS = np.linspace(0.05, 0.95, 19)  # a of the map that spreads nodes
_MOST_SPREAD = 32  # nodes; a search for more takes long


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


def band_limited_quadrature(half_range: float, tolerance: float, fewest: int = 1) -> tuple[np.ndarray, np.ndarray]:
    r"""Return nodes on [-1, 1] and weights, which sum to two, that integrate a linear phase within a tolerance.

    The integrand is that of :func:`gauss_legendre_order`. Gauss-Legendre nodes lie denser at the ends than waves need.
    The map :math:`t \mapsto \arcsin(a t) / \arcsin a` spreads them, so that fewer are enough.

    Args:
        half_range: largest phase in radians, from the middle of the interval to its edge.
        tolerance: largest error allowed in the mean over the interval.
        fewest: nodes.

    Raises:
        ValueError: if ``half_range`` is NaN or infinite.

    Source: Kosloff and Tal-Ezer, J. Comput. Phys. 104, 457 (1993); Hale and Trefethen, SIAM Journal on Numerical
    Analysis 46, 930 (2008).

    Example:
        >>> gauss_legendre_order(7.0, 1e-3), len(band_limited_quadrature(7.0, 1e-3)[0])
        (7, 5)
    """
    most = max(fewest, gauss_legendre_order(half_range, tolerance))
    b = np.linspace(0, half_range, 33)[:, None]
    for order in range(fewest, min(most, _MOST_SPREAD)):
        for part in _SPREADS:
            nodes, weights = _leggauss(order)
            weights = weights / np.sqrt(1 - (part * nodes) ** 2)
            nodes, weights = np.arcsin(part * nodes) / math.asin(part), weights * (2 / weights.sum())
            if np.abs(np.cos(b * nodes) @ weights / 2 - np.sinc(b[:, 0] / np.pi)).max() <= tolerance:
                return nodes, weights
    return _leggauss(most)


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
