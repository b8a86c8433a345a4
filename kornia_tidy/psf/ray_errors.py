r"""Transverse ray errors of a lens: where rays through points of its stop meet the sensor, for spot diagrams.

The optical path V(q, P) from a point q of the stop to a point P of the sensor is a point characteristic: its gradients
are the direction cosines of the ray that joins the two. The object's ray through q is the one that joins q and P + e,
so that to first order in the error e

.. math:: \Big( \frac{\partial (L, M)}{\partial q} \Big)^T e = - \frac{\partial W}{\partial q}

with the wavefront W and the direction cosines L, M in which light arrives at P, as a lens's table holds them.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from kornia_tidy.optics.default_device import on_cpu
from kornia_tidy.optics.zernike import zernike_polynomials
from kornia_tidy.psf.lens_psfs import TurnedLens, wavefronts

_STEP = 1e-4  # of differences over the stop, in its radii


@on_cpu
def ray_errors(turned: TurnedLens, y: Tensor, x: Tensor) -> Tensor:
    """Return where rays land, less where the chief ray of the same wavelength does, (D, S, 2): y and x in metres.

    Args:
        turned: the lens at a field point and D depths, see :func:`~kornia_tidy.psf.lens_psfs.turned_lenses`.
        y: of S points in the stop, in its radii.
        x: the same along the other axis.

    Source: Born and Wolf, Principles of Optics, sections 4.1 (point characteristic) and 5.1 (ray aberrations).

    Example:
        >>> from kornia_tidy.optics import Lens
        >>> from kornia_tidy.psf.lens_psfs import turned_lenses
        >>> lens, edge = Lens.from_seidel(50e-3, 5.0, float("inf"), 10e-3), torch.tensor([1.0])
        >>> (turned,) = turned_lenses(lens.table, [(0.0, 0.0)], [10.0], 530e-9)
        >>> errors = ray_errors(turned, edge, 0 * edge)  # psi 530 nm / pi, over the cone's 1 / 10
        >>> [round(1e6 * error, 2) for error in errors[0, 0].tolist()]
        [16.87, 0.0]
    """
    y, x = y.double(), x.double()
    (down, rows), (right, columns) = (_slopes(turned, y, x, axis) for axis in (0, 1))
    slopes, jacobian = torch.stack([down, right], -1), torch.stack([rows, columns], -2)  # (D, S, 2), (S, 2, 2)
    return torch.linalg.solve(jacobian, -slopes[..., None])[..., 0]


def rays_in_stop(turned: TurnedLens, rings: int = 8) -> tuple[Tensor, Tensor]:
    """Return y and x of points that cover the open stop evenly, (S,) each in its radii: rings of 6, 12, ... points.

    Points that a surface's rim takes away are left out.

    Example:
        >>> from kornia_tidy.optics import Lens
        >>> from kornia_tidy.psf.lens_psfs import turned_lenses
        >>> (turned,) = turned_lenses(Lens.from_seidel(50e-3, 5.0, 1.0, 10e-3).table, [(0.0, 0.0)], [0.0], 530e-9)
        >>> len(rays_in_stop(turned, 3)[0])
        37
    """
    points = [(0.0, 0.0)]
    for ring in range(1, rings + 1):
        points += [(ring / (rings + 0.5), i * math.pi / (3 * ring)) for i in range(6 * ring)]
    radius, angle = torch.tensor(points, dtype=torch.float64).T
    y, x = radius * torch.sin(angle), radius * torch.cos(angle)
    centre_x, centre_y, edge = turned.discs().T[..., None]
    open_ = (torch.hypot(x - centre_x, y - centre_y) <= edge).all(0)
    return y[open_], x[open_]


def _slopes(turned: TurnedLens, y: Tensor, x: Tensor, axis: int) -> tuple[Tensor, Tensor]:
    """Return the slopes of the wavefront, (D, S) metres, and of the cosines along y and x, (S, 2), along an axis."""
    step = torch.tensor([-_STEP, _STEP], dtype=torch.float64)[:, None]
    y, x = (y + step, x.expand(2, -1)) if axis == 0 else (y.expand(2, -1), x + step)
    polynomials = zernike_polynomials((turned.degree + 1) * (turned.degree + 2) // 2, y, x)
    phases, cosines = (part[0].unflatten(-1, (2, -1)) for part in wavefronts([turned], polynomials.flatten(1)))
    slopes, bends = ((part[:, 1] - part[:, 0]) / (2 * _STEP) for part in (phases, cosines))
    return slopes * turned.wavelength / (2 * math.pi), bends.T
