"""Cubic masks: cubic phase for extended depth of field."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from kornia_tidy.masks.base import PhaseMasks, Size, mask_axes
from kornia_tidy.optics.materials import Material


class CubicMask(PhaseMasks):
    r"""Masks of cubic phase :math:`\alpha (x^3 + y^3)`, whose transfer function hardly changes with defocus.

    Args:
        strength: :math:`\alpha` in radians at 530 nm, the phase at the pupil's edge on the x or y axis; one number for
            each mask.
        size: pixels N along a side, or (rows, columns).
        material: refractive index of the element. Default: 1.5 at every wavelength.
        constraint: see :class:`PhaseMasks`.
        max_height: in metres, see :class:`PhaseMasks`.

    Shape:
        - ``strength``: learnable parameter (K,), radians at 530 nm. A strength of 1 rad has 0.40 rad rms over the
          pupil.
        - ``phase``: (K, N, N).

    Raises:
        ValueError: if the strengths are missing or not finite.

    Source: Dowski and Cathey, Applied Optics 34(11) 1859 (1995).

    Example:
        >>> CubicMask([20.0, -20.0]).phase[:, 11, 21].detach()  # on the x axis, at the edge
        tensor([ 20., -20.])
    """

    shape: Tensor

    def __init__(
        self,
        strength: float | Sequence[float] | Tensor = 20.0,
        size: Size = 23,
        material: Material | None = None,
        constraint: str = "none",
        max_height: float | None = None,
    ) -> None:
        super().__init__(material, constraint, max_height)
        values = torch.as_tensor(strength, dtype=torch.get_default_dtype()).detach().clone().reshape(-1)
        if not (len(values) and (values.is_meta or bool(torch.isfinite(values).all()))):
            raise ValueError(f"strength must be one finite number of radians for each mask, got {strength}")
        y, x = mask_axes(size)
        self.register_buffer("shape", (x**3 + y**3).to(values), persistent=False)
        self.strength = nn.Parameter(values)

    @classmethod
    def arguments_of(cls, parameters: Mapping[str, Tensor]) -> dict[str, Any]:
        """Return the arguments that follow from the parameters of a state. See :meth:`PhaseMasks.arguments_of`."""
        return {"strength": parameters["strength"]}

    def free_phase(self) -> Tensor:
        """Return the cubic phase, (K, N, N) radians."""
        return self.strength[:, None, None] * self.shape
