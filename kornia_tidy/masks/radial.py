"""Rotationally symmetric masks: a height profile along the radius, as of a diamond-turned element."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from kornia_tidy.masks.base import (
    MASK_SPAN,
    NOISE_RMS,
    PhaseMasks,
    Size,
    gather_values,
    initial_values,
    mask_axes,
)
from kornia_tidy.optics.materials import Material


class RadialMask(PhaseMasks):
    r"""Masks with a phase that depends only on the radius, linear between evenly spaced radii.

    Args:
        num_masks: number K of masks shown one after the other during the exposure.
        size: pixels N along a side, or (rows, columns).
        num_radii: number of radii from 0 to 1 with a free phase, at least 2. Default: spaced no wider than the pixels.
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
        - Beyond the pupil's edge the phase is that at the edge.

    Source: Ikoma et al., Depth from Defocus with Learned Optics (ICCP 2021), section 3.

    Example:
        >>> cone = RadialMask(initial=torch.linspace(0, 5, 11))
        >>> cone.phase[0, 11, 11:17].detach()
        tensor([0.0000, 0.5000, 1.0000, 1.5000, 2.0000, 2.5000])
    """

    inner_index: Tensor
    outer_weight: Tensor

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
        position = torch.hypot(y, x).clamp(max=1) * (num_radii - 1)
        inner = position.floor().clamp(max=num_radii - 2)
        self.register_buffer("inner_index", inner.long(), persistent=False)
        self.register_buffer("outer_weight", (position - inner).to(torch.get_default_dtype()), persistent=False)
        self.profile = nn.Parameter(initial_values(initial, num_masks, (num_radii,), NOISE_RMS, generator))

    @classmethod
    def arguments_of(cls, parameters: Mapping[str, Tensor]) -> dict[str, Any]:
        """Return the arguments that follow from the parameters of a state. See :meth:`PhaseMasks.arguments_of`."""
        return {**super().arguments_of(parameters), "num_radii": parameters["profile"].shape[1]}

    def free_phase(self) -> Tensor:
        """Return the profile interpolated at the radius of each pixel, (K, N, N) radians."""
        inner, outer = (gather_values(self.profile, self.inner_index + step) for step in (0, 1))
        return torch.lerp(inner, outer, self.outer_weight)
