"""Rotationally symmetric masks: a profile of height along the radius, as a diamond-turned element has."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from kornia_tidy.masks.base import MASK_SPAN, NOISE_RMS, PhaseMasks, Size, initial_values, mask_axes, spread
from kornia_tidy.optics.materials import Material


class RadialMask(PhaseMasks):
    r"""Masks whose phase depends on the radius alone, linear between evenly spaced radii.

    Args:
        num_masks: number K of masks shown one after the other during the exposure.
        size: pixels N along a side, or (rows, columns).
        num_radii: number of radii from 0 to 1 at which the phase is free, at least 2. Default: as fine as the pixels.
        initial: ``"noise"`` (normal, 2.05 rad rms), ``"flat"``, or the phase at the radii in radians at 530 nm as a
            (K, num_radii) or (num_radii,) tensor.
        material: refractive index of the element. Default: 1.5 at every wavelength.
        generator: source of the noise.
        constraint: see :class:`PhaseMasks`.
        max_height: in metres, see :class:`PhaseMasks`.

    Shape:
        - ``profile``: learnable parameter (K, num_radii), radians at 530 nm.
        - ``phase``: (K, N, N).

    Raises:
        ValueError: if ``num_radii`` is below 2, or given values have another shape or are not finite.

    Convention:
        - Beyond the pupil's edge a mask keeps the phase it has at the edge.

    Source: Ikoma et al., Depth from Defocus with Learned Optics (ICCP 2021), section 3.

    Example:
        >>> cone = RadialMask(initial=torch.linspace(0, 5, 11))
        >>> cone.phase[0, 11, 11:17].detach()
        tensor([0.0000, 0.5000, 1.0000, 1.5000, 2.0000, 2.5000])
    """

    inner: Tensor
    share: Tensor

    def __init__(
        self,
        num_masks: int = 5,
        size: Size = 23,
        num_radii: int | None = None,
        initial: str | Tensor = "noise",
        material: Material | None = None,
        generator: torch.Generator | None = None,
        constraint: str = "none",
        max_height: float | None = None,
    ) -> None:
        super().__init__(material, constraint, max_height)
        y, x = mask_axes(size)
        if num_radii is None:
            num_radii = math.ceil(min(len(y), len(x)) / MASK_SPAN - 1e-9) + 1
        if num_radii < 2:
            raise ValueError(f"num_radii must be at least 2, got {num_radii}")
        place = torch.hypot(y, x).clamp(max=1) * (num_radii - 1)
        inner = place.floor().clamp(max=num_radii - 2)
        self.register_buffer("inner", inner.long(), persistent=False)
        self.register_buffer("share", (place - inner).to(torch.get_default_dtype()), persistent=False)
        self.profile = nn.Parameter(initial_values(initial, num_masks, (num_radii,), NOISE_RMS, generator))

    def free_phase(self) -> Tensor:
        """Return the profile turned around the axis, (K, N, N) radians."""
        return torch.lerp(spread(self.profile, self.inner), spread(self.profile, self.inner + 1), self.share)
