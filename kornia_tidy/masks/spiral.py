"""Spiral masks: rings of vortex phase, whose PSF rotates with defocus."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from kornia_tidy.checks import check_choice, check_positive
from kornia_tidy.masks.base import (
    NOISE_RMS,
    PhaseMasks,
    Size,
    check_number_of_masks,
    gather_values,
    initial_values,
    mask_axes,
)
from kornia_tidy.optics.materials import Material


class SpiralMask(PhaseMasks):
    r"""Masks of L rings of equal area, each a vortex phase with its own charge (orbital angular momentum).

    .. math:: \varphi(\rho, \theta) = \ell_z\, \theta + \beta_z \qquad \sqrt{(z-1)/L} \le \rho < \sqrt{z/L}

    With charges :math:`\ell_z = z` and without offsets these are Prasad's spiral zones: defocus acts as a rotation of
    the mask, and the PSF rotates rigidly by :math:`\psi / L`. Liu et al. learn masks of orbital angular momentum too,
    with another formula.

    Args:
        num_masks: number K of masks shown one after the other during the exposure.
        size: pixels N along a side, or (rows, columns). The outermost ring is 1 / (2L) pupil radii wide, and pixels
            must be well below that: about 128 for 7 rings.
        num_zones: number L of rings.
        initial: ``"noise"`` (charges 1 to L and random offsets), or ``"rotating"`` (charges 1 to L, no offsets).
        material: refractive index of the element. Default: 1.5 at every wavelength.
        generator: source of the noise.
        constraint: see :class:`PhaseMasks`; ``"wrapped"`` gives a diffractive element, as these masks are made.
        max_height: in metres, see :class:`PhaseMasks`.

    Shape:
        - ``charges``: learnable parameter (K, L), radians at 530 nm for each radian of azimuth. With a whole number a
          ring has no phase jump at 530 nm; otherwise the jump lies at -x.
        - ``offsets``: learnable parameter (K, L), radians at 530 nm.
        - ``phase``: (K, N, N).

    Raises:
        ValueError: if ``num_zones`` is not positive, or ``initial`` is unknown.

    Convention:
        - The azimuth runs from +x towards +y, which is down in an image. The PSF rotates the other way, from +y towards
          +x (anticlockwise in the image), as the scene comes nearer.

    Source: Prasad, Optics Letters 38(4) 585 (2013), for the zones; Liu et al., Optics Express 30(20) 36973 (2022), for
    orbital angular momentum in a learnt mask.

    Example:
        >>> SpiralMask(1, 128, initial="rotating").charges.tolist()
        [[1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]]
    """

    zone: Tensor
    azimuth: Tensor

    def __init__(
        self,
        num_masks: int = 5,
        size: Size = 128,
        num_zones: int = 7,
        initial: str = "noise",
        material: Material | None = None,
        generator: torch.Generator | None = None,
        constraint: str = "none",
        max_height: float | None = None,
    ) -> None:
        super().__init__(material, constraint, max_height)
        check_number_of_masks(num_masks)
        check_positive("num_zones", num_zones)
        check_choice("initial", initial, ("noise", "rotating"))
        y, x = mask_axes(size)
        zone = ((y**2 + x**2) * num_zones).floor().clamp(max=num_zones - 1)  # the last ring extends beyond the edge
        self.register_buffer("zone", zone.long(), persistent=False)
        self.register_buffer("azimuth", torch.atan2(y, x).to(torch.get_default_dtype()), persistent=False)
        offsets = "flat" if initial == "rotating" else initial
        self.charges = nn.Parameter(torch.arange(1.0, num_zones + 1).repeat(num_masks, 1))
        self.offsets = nn.Parameter(initial_values(offsets, num_masks, (num_zones,), NOISE_RMS, generator))

    @classmethod
    def arguments_of(cls, parameters: Mapping[str, Tensor]) -> dict[str, Any]:
        """Return the arguments that follow from the parameters of a state. See :meth:`PhaseMasks.arguments_of`."""
        return {**super().arguments_of(parameters), "num_zones": parameters["charges"].shape[1]}

    def free_phase(self) -> Tensor:
        """Return the vortex phase of the rings, (K, N, N) radians."""
        offsets, charges = (gather_values(values, self.zone) for values in (self.offsets, self.charges))
        return torch.addcmul(offsets, charges, self.azimuth)
