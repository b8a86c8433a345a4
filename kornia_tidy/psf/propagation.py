r"""Light from the pupil to the sensor's pixels: a Fourier transform as two small matrices.

The phase of defocus is separable, :math:`\psi\rho^2 = \psi x^2 + \psi y^2`, and a pixel of the mask has one phase. So
the integral of the defocused wave over every mask pixel is a product of two one-dimensional integrals, and the field
on the sensor is ``kernel @ field @ kernel.T`` with one small matrix for each depth and wavelength. Nothing is sampled
in the pupil, so nothing aliases there, whatever the defocus.

Source: Soummer, Pueyo, Sivaramakrishnan and Vanderbei, Optics Express 15(24) 15935 (2007), for the matrix transform.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from kornia_tidy.optics.quadrature import gauss_legendre, gauss_legendre_order

CELL_TOLERANCE = 1e-9  # of the integrals over mask pixels: exact for every purpose, and they cost next to nothing


def cell_integrals(
    defocus: Sequence[float],
    frequency: Tensor,
    highest: float,
    num_cells: int,
    pitch: float,
    cells: Tensor | None = None,
    moment: int = 0,
) -> Tensor:
    r"""Return the integrals of a defocused plane wave over each cell of the pupil along one axis.

    .. math:: K_{dun} = \int_{x_n - p/2}^{x_n + p/2} x^m \exp(i \psi_d x^2 - 2\pi i u x) \, dx

    Args:
        defocus: :math:`\psi_d` in radians at the pupil edge, at the wavelength in use.
        frequency: u in cycles per pupil radius, (U,); may carry gradients.
        highest: bound of the frequencies' modulus.
        num_cells: cells N along the axis, centred on the optical axis.
        pitch: side p of a cell in pupil radii.
        cells: where to integrate instead, begin and end of each interval in cells from the optical axis, (2, N').
        moment: m; the first and the second make the slopes of the integrals over frequency and over defocus.

    Returns:
        Integrals in pupil radii, (D, U, N) complex128: in float64 because phases reach thousands of radians.

    Example:
        >>> cell_integrals([0.0], torch.zeros(1), 0.0, 4, 0.5).real.round(decimals=6).flatten().tolist()
        [0.5, 0.5, 0.5, 0.5]
    """
    edge = num_cells * pitch / 2
    slopes = [2 * abs(psi) * edge + 2 * math.pi * highest for psi in defocus]  # of the phase, radians a pupil radius
    orders = [gauss_legendre_order(slope * pitch / 2, CELL_TOLERANCE) for slope in slopes]
    if len(set(orders)) > 1:  # each depth by its own points, whatever others are asked for
        alike = {order: [psi for psi, own in zip(defocus, orders, strict=True) if own == order] for order in orders}
        rest = frequency, highest, num_cells, pitch, cells, moment
        found = {order: iter(cell_integrals(nodes, *rest)) for order, nodes in alike.items()}
        return torch.stack([next(found[order]) for order in orders])
    points, weights = gauss_legendre(orders[0], frequency.device)
    if cells is None:
        centres = torch.arange(num_cells, dtype=torch.float64, device=frequency.device) - (num_cells - 1) / 2
        widths = torch.ones_like(centres)
    else:
        begin, end = cells.to(frequency.device)
        centres, widths = (begin + end) / 2, end - begin
    x = (centres[:, None] + widths[:, None] * points) * pitch
    psi = torch.tensor(defocus, dtype=torch.float64, device=x.device)
    lens = torch.exp(1j * psi[:, None, None] * x**2) * (widths[:, None] * weights * pitch * x**moment)
    rotation = -2j * math.pi * pitch * frequency[:, None]
    if cells is None:  # all cells have the same points around their centres, so that no (U, N, points) is needed
        return torch.exp(rotation * centres) * torch.einsum("ug,dng->dun", torch.exp(rotation * points), lens)
    return torch.einsum("ung,dng->dun", torch.exp(-2j * math.pi * frequency[:, None, None] * x), lens)


def pixel_frequencies(step: float | Tensor, window: int, order: int, device: torch.device | None = None) -> Tensor:
    """Return where a window of sensor pixels is sampled, as spatial frequency in the pupil, (window * order,) float64.

    Args:
        step: a pixel's side in cycles per pupil radius: pitch * R / (wavelength * image distance).
        window: pixels along a side, odd.
        order: Gauss-Legendre points for each pixel; 1 samples the pixel's centre.
        device: where to put them.

    Example:
        >>> pixel_frequencies(0.5, 3, 1).tolist()
        [-0.5, 0.0, 0.5]
    """
    centres = torch.arange(window, dtype=torch.float64, device=device) - window // 2
    points, _ = gauss_legendre(order, device)
    return (centres[:, None] + points).flatten() * step


def sensor_kernels(
    defocus: Sequence[float],
    step: float | Tensor,
    window: int,
    num_cells: int,
    pitch: float,
    extent: float,
    tolerance: float,
    device: torch.device | None = None,
    cells: Tensor | None = None,
    moment: int = 0,
) -> Tensor:
    r"""Return the matrices that take a pupil field to the sensor's pixels, one for each depth.

    Args:
        defocus: radians at the pupil edge at the wavelength in use, (D,).
        step: a pixel's side in cycles per pupil radius at that wavelength; may carry gradients.
        window: pixels P along a side of the PSF, odd.
        num_cells: cells N of the pupil along a side.
        pitch: side of a cell in pupil radii.
        extent: half width of the open pupil in pupil radii; it bounds the PSF's bandwidth to twice itself.
        tolerance: error allowed to the integral over a pixel of the finest pattern the pupil can make.
        device: where to put them.
        cells: where to integrate instead of the N cells, see :func:`cell_integrals`.
        moment: power of the place in the pupil to integrate with, see there.

    Returns:
        (D, P, q, N) complex128, weighted so that the sum of \|kernel @ field @ kernel.T\|^2 over the q points of a
        pixel is the light in that pixel.

    Example:
        >>> sensor_kernels([0.0] * 21, 0.4, 23, 23, 0.1, 1.05, 1e-3).shape
        torch.Size([21, 23, 4, 23])
    """
    pixel = float(step.detach()) if isinstance(step, Tensor) else step
    order = gauss_legendre_order(2 * math.pi * extent * pixel, tolerance)
    frequency = pixel_frequencies(step, window, order, device)
    integrals = cell_integrals(defocus, frequency, pixel * window / 2, num_cells, pitch, cells, moment)
    _, weights = gauss_legendre(order, device)
    scale = (weights.sqrt() * step**0.5).repeat(window)  # squared by the intensity, once for each axis
    return (integrals * scale[:, None]).unflatten(1, (window, order))
