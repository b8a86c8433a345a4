"""No mask: only a lens, with a smooth disc as its pupil and not the open pixels of a modulator."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from kornia_tidy.masks.base import MASK_SPAN, PhaseMasks, mask_axes
from kornia_tidy.optics.aperture import OpenArea, circular_aperture
from kornia_tidy.optics.materials import Material


class NoMask(PhaseMasks):
    """No mask: one flat state, and a smooth circular pupil where the camera is given no aperture.

    A flat :class:`~kornia_tidy.masks.pixelwise.PixelwiseMask` is a modulator that shows nothing. Its pupil consists of
    the pixels with centres in the disc, 317 of 23x23: against the disc its PSFs are off by 0.05 in focus and 0.13
    at psi = 20 (L1, at 530 nm in 41 px of the default camera). Those of 92x92 open areas are off by 0.003 and 0.007.

    Args:
        size: cells N along a side of the pupil's grid.
        material: refractive index; without effect.

    Shape:
        - ``phase``: fixed (1, N, N), zero.
        - ``iris``: (N, N), open areas.

    Raises:
        ValueError: if the size is not positive.

    Example:
        >>> from kornia_tidy.camera.tidy_optics import TiDyOptics
        >>> optics = TiDyOptics(NoMask(), fidelity="draft")
        >>> round(optics.pupil.light, 6), list(optics.parameters())
        (3.141593, [])
    """

    def __init__(self, size: int = 92, material: Material | None = None) -> None:
        super().__init__(material)
        y, x = mask_axes(size)
        zero = torch.zeros(1, len(y), len(x), dtype=torch.get_default_dtype())
        self.register_buffer("phase", zero, persistent=False)

    @property
    def iris(self) -> OpenArea:
        """The disc on the grid of the phase, as open areas."""
        size = self.free_phase().shape[-1]
        return circular_aperture(size, MASK_SPAN / size, edges="area").as_subclass(OpenArea)

    @classmethod
    def arguments_of(cls, parameters: Mapping[str, Tensor]) -> dict[str, Any]:
        """Return the arguments that follow from the parameters of a state: none."""
        return {}
