"""Zernike polynomials: functions on a disc that are orthonormal there, in the order of OSA/ANSI."""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch
from torch import Tensor

from kornia_tidy.checks import check_positive


def zernike_polynomials(num_modes: int, y: Tensor, x: Tensor) -> Tensor:
    r"""Return Zernike polynomials in the order of OSA/ANSI, orthonormal on the unit disc.

    .. math::
        Z_n^m = \sqrt{(2 - \delta_{m0})(n + 1)}\; R_n^{|m|}(\rho)
        \begin{cases} \cos m\theta & m \ge 0 \\ \sin |m|\theta & m < 0 \end{cases}, \qquad j = \frac{n(n+2) + m}{2}

    Args:
        num_modes: number M of polynomials.
        y: coordinates in pupil radii, (..., N, 1) or of the shape of the grid.
        x: the same along the other axis, (N,) or of the shape of the grid.

    Returns:
        (M, ...) float64, each of mean square one over the disc (Noll's normalisation).

    Raises:
        ValueError: if ``num_modes`` is not positive.

    Convention:
        - The azimuth runs from +x towards +y, which is down in an image: :math:`Z_1 = 2y`, :math:`Z_2 = 2x`.

    Source: Thibos et al., J. Refract. Surg. 18, S652 (2002), for order and norm. The radial polynomials come from the
    recurrence :math:`R_n^m = \rho (R_{n-1}^{|m-1|} + R_{n-1}^{m+1}) - R_{n-2}^m` of Honarvar Shakibaei and Paramesran,
    Optics Letters 38(14) 2487 (2013), which needs no factorials and is stable at every order.

    Example:
        >>> zernike_polynomials(5, torch.tensor(0.0), torch.tensor(1.0)).round(decimals=4)
        tensor([1.0000, 0.0000, 2.0000, 0.0000, 1.7321], dtype=torch.float64)
    """
    check_positive("num_modes", num_modes)
    y, x = torch.broadcast_tensors(y.double(), x.double())
    radius, azimuth = torch.hypot(y, x), torch.atan2(y, x)
    modes = []
    for n, radial in _radial_polynomials(radius):
        for m in range(-n, n + 1, 2):
            norm = math.sqrt((n + 1) * (2 if m else 1))
            wave = torch.cos(m * azimuth) if m >= 0 else torch.sin(-m * azimuth)
            modes.append(norm * radial[abs(m)] * wave)
            if len(modes) == num_modes:
                return torch.stack(modes)
    raise AssertionError  # unreachable: the loop above returns


def _radial_polynomials(radius: Tensor) -> Iterator[tuple[int, dict[int, Tensor]]]:
    """Yield the radial orders n = 0, 1, ..., each with its polynomials R_n^m as a dictionary over m."""
    zero = torch.zeros_like(radius)
    before: dict[int, Tensor] = {}
    last: dict[int, Tensor] = {0: torch.ones_like(radius)}
    n = 0
    while True:
        yield n, last
        n += 1
        new = {
            m: radius * (last.get(abs(m - 1), zero) + last.get(m + 1, zero)) - before.get(m, zero)
            for m in range(n % 2, n + 1, 2)
        }
        before, last = last, new
