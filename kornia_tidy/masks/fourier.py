"""Fourier masks: smooth surfaces of low spatial frequency."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor, nn

from kornia_tidy.checks import check_positive
from kornia_tidy.masks.base import NOISE_RMS, PhaseMasks, Size, initial_values, mask_axes
from kornia_tidy.optics.materials import Material


class FourierMask(PhaseMasks):
    r"""Masks that are sums of waves of low spatial frequency: :math:`\varphi_k = \sum_{pq} c_{kpq}\, w_p(y)\, w_q(x)`.

    The 2F + 1 waves along an axis are :math:`1, \sqrt2 \cos(2\pi f x / W), \sqrt2 \sin(2\pi f x / W)` for f = 1 to F
    over the mask's width W, so a coefficient is the root mean square of its wave over the mask. Together they span
    every surface with frequencies of at most F cycles across the mask along both axes.

    Args:
        num_masks: number K of masks shown one after the other during the exposure.
        size: pixels N along a side, or (rows, columns).
        max_frequency: highest frequency F in cycles across the mask, below half the number of pixels.
        initial: ``"noise"`` (normal, 2.05 rad rms in all), ``"flat"``, or coefficients as a (K, 2F + 1, 2F + 1) tensor
            in the order 1, cos 1 to cos F, sin 1 to sin F along each axis.
        material: refractive index of the element. Default: 1.5 at every wavelength.
        generator: source of the noise.
        constraint: see :class:`PhaseMasks`.
        max_height: in metres, see :class:`PhaseMasks`.

    Shape:
        - ``coefficients``: learnable parameter (K, 2F + 1, 2F + 1), axes (mask, y, x), radians rms at 530 nm.
        - ``phase``: (K, N, N).

    Raises:
        ValueError: if ``max_frequency`` is not from 1 to below half the pixels, or given values do not fit.

    Source: Sitzmann et al., ACM Trans. Graph. 37(4) 114 (2018): they keep three quarters of the frequencies.

    Example:
        >>> masks = FourierMask(num_masks=2, max_frequency=3)
        >>> masks.coefficients.shape, masks.phase.shape
        (torch.Size([2, 7, 7]), torch.Size([2, 23, 23]))
    """

    waves_y: Tensor
    waves_x: Tensor

    def __init__(
        self,
        num_masks: int = 5,
        size: Size = 23,
        max_frequency: int = 5,
        initial: str | Tensor = "noise",
        material: Material | None = None,
        generator: torch.Generator | None = None,
        constraint: str = "none",
        max_height: float | None = None,
    ) -> None:
        super().__init__(material, constraint, max_height)
        check_positive("max_frequency", max_frequency)
        y, x = mask_axes(size)
        shorter = min(len(y), len(x))
        if not 2 * max_frequency < shorter:
            raise ValueError(f"max_frequency must be below half the {shorter} pixels, got {max_frequency}")
        for name, axis in (("waves_y", y.flatten()), ("waves_x", x)):
            waves = _waves(axis, max_frequency).to(torch.get_default_dtype())
            self.register_buffer(name, waves, persistent=False)
        count = 2 * max_frequency + 1
        values = initial_values(initial, num_masks, (count, count), NOISE_RMS / count, generator)
        self.coefficients = nn.Parameter(values)

    @classmethod
    def arguments_of(cls, parameters: Mapping[str, Tensor]) -> dict[str, Any]:
        """Return the arguments that follow from the parameters of a state. See :meth:`PhaseMasks.arguments_of`."""
        return {**super().arguments_of(parameters), "max_frequency": parameters["coefficients"].shape[1] // 2}

    def free_phase(self) -> Tensor:
        """Return the sum of the waves before the constraint, (K, N, N) radians."""
        return self.waves_y.mT @ self.coefficients @ self.waves_x


def _waves(axis: Tensor, max_frequency: int) -> Tensor:
    """Return the constant, cosines and sines along an evenly spaced axis, (2F + 1, N), each of mean square one."""
    angles = torch.arange(1, max_frequency + 1, dtype=torch.float64)[:, None] * (
        axis / (axis.diff().mean() * len(axis)) * 2 * math.pi
    )
    return torch.cat([torch.ones_like(axis)[None], math.sqrt(2) * angles.cos(), math.sqrt(2) * angles.sin()])
