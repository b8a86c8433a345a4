r"""Measured PSFs over the field: between the places that were measured they follow a thin plate, place by place.

.. math:: h(p) = \sum_i w_i(p)\, h_i, \qquad w_i(p_j) = \delta_{ij}, \qquad \sum_i w_i = 1

Source: Duchon, Splines minimizing rotation-invariant semi-norms in Sobolev spaces (1977), for the weights.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from kornia_tidy.optics.default_device import on_cpu
from kornia_tidy.psf.field import Field, chebyshev_points, lagrange
from kornia_tidy.psf.field_nodes import MOST_NODES, cells_within

_FINE = 17  # places along a side at which PSFs between nodes are compared


@on_cpu
def place_weights(measured: Tensor, places: Sequence[tuple[float, float]]) -> Tensor:
    """Return the weights of measured places at other places, (n, F) float64.

    Beyond the rectangle around the measured places they are those of its nearest point.

    Args:
        measured: (F, 2), y and x.
        places: n of them, in the same unit.

    Example:
        >>> square = torch.tensor([[0.0, 0.0], [0.0, 2.0], [2.0, 0.0], [2.0, 2.0]])
        >>> place_weights(square, [(1.0, 1.0), (5.0, 0.0)]).round(decimals=6).abs()
        tensor([[0.2500, 0.2500, 0.2500, 0.2500],
                [0.0000, 0.0000, 1.0000, 0.0000]], dtype=torch.float64)
    """
    known = measured.detach().double().cpu()
    low, high = known.amin(0), known.amax(0)
    scale = float((high - low).max()) or 1.0
    wanted = (torch.tensor(places, dtype=torch.float64).clamp(low, high) - low) / scale
    known = (known - low) / scale

    def terms(at: Tensor) -> tuple[Tensor, Tensor]:
        away = torch.cdist(at, known, compute_mode="donot_use_mm_for_euclid_dist")
        return torch.special.xlogy(away.square(), away), torch.cat([torch.ones_like(at[:, :1]), at], 1)

    plate, plane = terms(known)
    corner = plate.new_zeros(plane.shape[1], plane.shape[1])
    whole = torch.cat([torch.cat([plate, plane], 1), torch.cat([plane.T, corner], 1)])
    return (torch.cat(terms(wanted), 1) @ torch.linalg.pinv(whole, hermitian=True))[:, : len(known)]


@on_cpu
def measured_nodes(
    psfs: Tensor, measured: Tensor, size: tuple[int, int], center: tuple[float, float], tolerance: float
) -> Field:
    """Return the fewest nodes over a picture, and the largest cells, that follow measured PSFs within a tolerance.

    Args:
        psfs: (F, ...) at the measured places.
        measured: (F, 2), y and x in pixels from the axis.
        size: rows and columns of the picture.
        center: of the picture, y and x from the axis.
        tolerance: relative error of PSFs (L2); :data:`~kornia_tidy.psf.field_nodes.MOST_NODES` may leave more.
    """
    values = psfs.detach().double().cpu().flatten(1)
    gram = values @ values.T
    gram = gram / gram.diagonal().mean()

    def norm(weights: Tensor) -> Tensor:
        return ((weights @ gram) * weights).sum(-1).clamp(min=0).sqrt()

    half = [(side - 1) / 2 for side in size]

    def weights_at(line: Sequence[float]) -> Tensor:
        grid = [(center[0] + half[0] * y, center[1] + half[1] * x) for y in line for x in line]
        return place_weights(measured, grid).unflatten(0, (len(line), len(line)))

    fine = torch.linspace(-1, 1, _FINE, dtype=torch.float64)
    exact, count = weights_at(fine.tolist()), 0
    for count in range(1, MOST_NODES + 1):
        along = lagrange(count, fine)[0]
        between = torch.einsum("ya,xb,abf->yxf", along, along, weights_at(chebyshev_points(count)))
        if float(norm(between - exact).max()) <= tolerance:
            break
    slope, bend = 0.0, 0.0
    for axis in (0, 1):  # as of lenses, see field_nodes
        step = float(fine[1] - fine[0]) * max(2 * half[axis], 1)
        slope = max(slope, float(norm(exact.diff(dim=axis)).max()) / step / math.sqrt(3))
        bend = max(bend, float(norm(exact.diff(n=2, dim=axis)).max()) / step**2 / math.sqrt(45))
    cell, still = cells_within(tolerance, slope, bend)
    return Field(size, (count, count), center, cell=cell, still=still)
