"""Zernike masks: sums of Zernike polynomials, which are orthonormal on the pupil's disc."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from kornia_tidy.masks.base import NOISE_RMS, PhaseMasks, Size, initial_values, mask_axes
from kornia_tidy.optics.materials import Material
from kornia_tidy.optics.zernike import zernike_polynomials


class ZernikeMask(PhaseMasks):
    r"""Masks that are sums of Zernike polynomials: :math:`\varphi_k = \sum_j c_{kj} Z_j`.

    Args:
        num_masks: number K of masks shown one after the other during the exposure.
        size: pixels N along a side, or (rows, columns).
        num_modes: number M of polynomials, in the order of OSA/ANSI from piston on. 55 are those up to radial order 9
            (PhaseCam3D); 350 are those up to order 25 but for the last one (Sitzmann et al.).
        initial: ``"noise"`` (normal coefficients, 2.05 rad rms over the pupil in all), ``"flat"``, or coefficients as
            a (K, M) or (M,) tensor.
        material: refractive index of the element. Default: 1.5 at every wavelength.
        generator: source of the noise.
        constraint: see :class:`PhaseMasks`.
        max_height: in metres, see :class:`PhaseMasks`.

    Shape:
        - ``coefficients``: learnable parameter (K, M), radians rms over the pupil at 530 nm.
        - ``phase``: (K, N, N).

    Raises:
        ValueError: if ``num_modes`` is not positive, or given values have another shape or are not finite.

    Convention:
        - Axes and normalisation are those of :func:`zernike_polynomials`.
        - Beyond the pupil's edge the phase is that at the edge, so that the polynomials do not grow in pixels that a
          smooth iris cuts through.

    Source: Wu et al., PhaseCam3D (ICCP 2019); Sitzmann et al., ACM Trans. Graph. 37(4) 114 (2018).

    Example:
        >>> masks = ZernikeMask(num_masks=2, initial=torch.eye(55)[[0, 4]])  # piston and defocus
        >>> masks.phase.shape, round(masks.phase[1, 11, 11].item(), 3)
        (torch.Size([2, 23, 23]), -1.732)
    """

    polynomials: Tensor
    order: Tensor

    def __init__(
        self,
        num_masks: int = 5,
        size: Size = 23,
        num_modes: int = 55,
        initial: str | Tensor = "noise",
        material: Material | None = None,
        generator: torch.Generator | None = None,
        constraint: str = "none",
        max_height: float | None = None,
    ) -> None:
        super().__init__(material, constraint, max_height)
        (y, x), polynomials = mask_axes(size), quarter_polynomials(num_modes, size)
        self.odd_sides = len(y) % 2 == 1  # of both sides or neither; then a middle row and column lie on the axes
        parities = [_parity(index) for index in range(num_modes)]
        self.group_sizes = [parities.count(kind) for kind in ((0, 0), (0, 1), (1, 0), (1, 1))]
        self.register_buffer("polynomials", polynomials.to(torch.get_default_dtype()), persistent=False)
        self.register_buffer("order", torch.tensor(_order(num_modes)), persistent=False)
        self.quarter = (len(y) - len(y) // 2, len(x) - len(x) // 2)
        rms = NOISE_RMS / math.sqrt(num_modes)
        self.coefficients = nn.Parameter(initial_values(initial, num_masks, (num_modes,), rms, generator))

    @classmethod
    def arguments_of(cls, parameters: Mapping[str, Tensor]) -> dict[str, Any]:
        """Return the arguments that follow from the parameters of a state. See :meth:`PhaseMasks.arguments_of`."""
        return {**super().arguments_of(parameters), "num_modes": parameters["coefficients"].shape[1]}

    def free_phase(self) -> Tensor:
        """Return the sum of the polynomials before the constraint, (K, N, N) radians."""
        groups = zip(
            self.coefficients[:, self.order].split(self.group_sizes, 1),
            self.polynomials.split(self.group_sizes),
            strict=True,
        )
        sums = [(strengths @ shapes).unflatten(1, self.quarter) for strengths, shapes in groups]
        halves = [self._mirrored(even, odd, -1) for even, odd in (sums[:2], sums[2:])]
        return self._mirrored(halves[0], halves[1], -2)

    def _mirrored(self, even: Tensor, odd: Tensor, axis: int) -> Tensor:
        """Return the sum of an even and an odd part on both sides of an axis, from its positive side."""
        middle = int(self.odd_sides)
        negative = (even - odd).narrow(axis, middle, even.shape[axis] - middle).flip(axis)
        return torch.cat([negative, even + odd], axis)


def quarter_polynomials(num_modes: int, size: Size) -> Tensor:
    """Return the polynomials on the lower right quarter of a mask, those of one parity together, (M, pixels) float64.

    Every polynomial is even or odd along each axis, so a quarter of the mask determines the rest.

    Example:
        >>> quarter_polynomials(55, 23).shape
        torch.Size([55, 144])
    """
    y, x = mask_axes(size)
    y, x = y[len(y) // 2 :], x[len(x) // 2 :]
    inward = torch.hypot(y, x).clamp(min=1)
    return zernike_polynomials(num_modes, y / inward, x / inward)[_order(num_modes)].flatten(1)


def _order(num_modes: int) -> list[int]:
    return sorted(range(num_modes), key=_parity)


def _parity(index: int) -> tuple[int, int]:
    """Return whether a polynomial is odd (1) or even (0) along y and along x."""
    n = (math.isqrt(8 * index + 1) - 1) // 2
    m = 2 * index - n * (n + 2)
    return int(m < 0), (m + (m < 0)) % 2
