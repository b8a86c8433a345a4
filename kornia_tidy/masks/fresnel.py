"""Diffractive lens: a fixed mask, the baseline for learnt ones."""

from __future__ import annotations

import math

import torch

from kornia_tidy.masks.base import PhaseMasks, Size, mask_axes
from kornia_tidy.optics.materials import Material


class FresnelLens(PhaseMasks):
    r"""A fixed diffractive lens: quadratic phase wrapped at 530 nm. It is the paper's baseline without learning.

    .. math:: h(\rho) = \frac{\lambda_0}{2\pi (n - 1)} \left[ \psi_F \rho^2 \bmod 2\pi \right]

    It shifts the focus by :math:`-\psi_F` at 530 nm and by other amounts at other wavelengths. This chromatic
    aberration encodes depth.

    Args:
        defocus: strength :math:`\psi_F` in radians at the edge of the pupil. The paper does not state its value; 10
            is the largest round number whose phase changes by less than :math:`\pi` between pixels of the 23x23 mask.
        size: pixels N along a side, or (rows, columns).
        material: refractive index of the element. Default: 1.5 at every wavelength.

    Shape:
        - ``phase``: fixed (1, N, N).

    Source: Shah et al., TiDy-PSFs (ICCV 2023), section 5 (the baseline named "0 phase masks").

    Example:
        >>> lens = FresnelLens()
        >>> float(lens.phase.max()) <= 2 * math.pi, list(lens.parameters())
        (True, [])
    """

    def __init__(self, defocus: float = 10.0, size: Size = 23, material: Material | None = None) -> None:
        super().__init__(material)
        y, x = mask_axes(size)
        quadratic = defocus * (y**2 + x**2)
        self.register_buffer("phase", quadratic.remainder(2 * math.pi)[None].to(torch.get_default_dtype()))
