"""Functions of field height on Chebyshev nodes that are mirrored at the axis, and of defocus as Chebyshev series."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def mirrored_nodes(count: int, crowding: float = 0.0) -> Tensor:
    r"""Return the nodes of a table over field height, from 0 to 1, ascending, (count,) float64.

    .. math:: h = (x + c x^3) / (1 + c), \qquad x_j = \sin \frac{\pi j}{2 (n - 1)}

    With their mirror images the x are the extrema of a Chebyshev polynomial, so that interpolation between them
    converges fast and does not oscillate.

    Args:
        count: n.
        crowding: c, the higher density of nodes at the axis. Lenses with odd powers of the radius need it.

    Example:
        >>> mirrored_nodes(3).round(decimals=3).tolist(), mirrored_nodes(3, 2.0).round(decimals=3).tolist()
        ([0.0, 0.707, 1.0], [0.0, 0.471, 1.0])
    """
    x = torch.sin(math.pi / 2 * torch.arange(count, dtype=torch.float64) / max(count - 1, 1))
    return (x + crowding * x**3) / (1 + crowding)


def height_weights(count: int, heights: Tensor, crowding: float = 0.0, *, odd: bool = False) -> Tensor:
    """Return the weights with which the values at the nodes of :func:`mirrored_nodes` make those at other heights.

    Args:
        count: of nodes.
        heights: (F,) in [0, 1].
        crowding: of the nodes.
        odd: for functions that change their sign at the axis; otherwise for functions that are mirrored there.

    Returns:
        (F, count) float64.

    Source: Berrut and Trefethen, Barycentric Lagrange interpolation, SIAM Review 46 (2004), section 5.

    Example:
        >>> height_weights(9, torch.tensor([0.3])) @ mirrored_nodes(9) ** 2
        tensor([0.0900], dtype=torch.float64)
    """
    if count == 1:
        return torch.ones(len(heights), 1, dtype=torch.float64) * (0.0 if odd else 1.0)
    half = mirrored_nodes(count)
    nodes = torch.cat([-half.flip(0)[:-1], half])
    signs = (-1.0) ** torch.arange(len(nodes), dtype=torch.float64)
    signs[0], signs[-1] = signs[0] / 2, signs[-1] / 2
    x = heights.double()
    for _ in range(30 if crowding else 0):  # Newton's method; from above it descends to the only root
        x = x - (x + crowding * x**3 - (1 + crowding) * heights) / (1 + 3 * crowding * x**2)
    distance = x[:, None] - nodes
    exact = distance == 0
    weights = signs / torch.where(exact, torch.ones_like(distance), distance)
    weights = torch.where(exact.any(1, keepdim=True), exact.double(), weights)
    weights = weights / weights.sum(1, keepdim=True)
    mirrored = weights[:, : count - 1].flip(1)
    folded = weights[:, count - 1 :].clone()
    folded[:, 1:] += -mirrored if odd else mirrored
    if odd:
        folded[:, 0] = 0
    return folded


def defocus_terms(defocus: Tensor, reach: tuple[float, float], count: int) -> Tensor:
    """Return Chebyshev polynomials of defocus, scaled to its range, (D, count) float64.

    Example:
        >>> defocus_terms(torch.tensor([5.0]), (-10.0, 10.0), 3)
        tensor([[ 1.0000,  0.5000, -0.5000]], dtype=torch.float64)
    """
    low, high = reach
    middle, half = (low + high) / 2, (high - low) / 2
    angle = torch.arccos(((defocus.double().clamp(low, high) - middle) / (half or 1.0)).clamp(-1, 1))
    return torch.cos(angle[:, None] * torch.arange(count, dtype=torch.float64))
