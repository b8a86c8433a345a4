"""Pixel-wise masks: one free height for each pixel of the modulator."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from kornia_tidy.checks import check_choice, check_generator, check_part
from kornia_tidy.masks.base import (
    HEIGHTS,
    PhaseMasks,
    Size,
    check_number_of_masks,
    mask_axes,
    metres_to_radians,
)
from kornia_tidy.masks.limits import unlimited_phase
from kornia_tidy.optics.materials import Material


class PixelwiseMask(PhaseMasks):
    r"""Masks with one free height for each pixel of the modulator.

    Args:
        num_masks: number K of masks shown one after the other during the exposure.
        size: pixels N along a side, or (rows, columns).
        initial: ``"noise"`` (heights uniform on [0, 1.2e-6] m, as in the paper), ``"flat"``, or heights in metres as a
            (K, N, N) or (N, N) tensor, whose shape replaces ``num_masks`` and ``size``. The paper's other initial masks
            are in :func:`~kornia_tidy.masks.initial_heights.initial_heights`.
        material: refractive index of the element. Default: 1.5 at every wavelength, as in the paper.
        generator: source of the noise.
        constraint: see :class:`PhaseMasks`. With "sigmoid", given heights change by up to a thousandth of the range.
        max_height: in metres, see :class:`PhaseMasks`.

    Shape:
        - ``phase``: learnable parameter (K, N, N). With a constraint the parameter holds the free phase.

    Raises:
        ValueError: if a size is not positive, or given heights have another shape, are not finite or exceed 1 mm.

    Source: Shah et al., TiDy-PSFs (ICCV 2023), section 5; Liu et al., Optics Express 30(20) 36973 (2022).

    Example:
        >>> masks = PixelwiseMask(num_masks=5)
        >>> masks.phase.shape, bool((masks.heights() <= 1.2e-6).all())
        (torch.Size([5, 23, 23]), True)
    """

    NOISE_HEIGHT = 1.2e-6  # m

    def __init__(
        self,
        num_masks: int = 5,
        size: Size = 23,
        initial: str | Tensor = "noise",
        material: Material | None = None,
        generator: torch.Generator | None = None,
        constraint: str = "none",
        max_height: float | None = None,
    ) -> None:
        super().__init__(material, constraint, max_height)
        to_radians = metres_to_radians(self.material)
        if isinstance(initial, Tensor):
            heights = initial[None] if initial.ndim == 2 else initial
            if heights.ndim != 3 or heights.numel() == 0:
                raise ValueError(f"initial heights must have shape (K, N, N) or (N, N), got {tuple(initial.shape)}")
            mask_axes((heights.shape[1], heights.shape[2]))  # raises if the mask cannot be centred on the pupil
            if not bool(torch.isfinite(heights).all()):
                raise ValueError("initial heights must be finite metres, got NaN or infinity")
            if (highest := float(heights.detach().abs().max())) > HEIGHTS[1]:
                raise ValueError(
                    f"initial heights must be metres within {HEIGHTS[1]:g} (1 um is 1e-6), got {highest:g}"
                )
            phase = (heights.detach().double() * to_radians).to(torch.get_default_dtype())
        else:
            check_generator(generator)
            check_part("initial", initial, str, "'noise', 'flat' or a torch.Tensor of heights in metres")
            check_choice("initial", initial, ("noise", "flat"))
            y, x = mask_axes(size)
            check_number_of_masks(num_masks, len(y) * len(x))
            phase = torch.zeros(num_masks, len(y), len(x))
            if initial == "noise":  # another type would draw other numbers
                noise = torch.rand(phase.shape, generator=generator, dtype=torch.float32)
                phase = (noise * (self.NOISE_HEIGHT * to_radians)).to(phase)
        self.register_parameter("phase", nn.Parameter(unlimited_phase(phase, constraint, self.max_phase)))
