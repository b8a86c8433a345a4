"""Phase masks: height maps of an optical element in the pupil, one for each state shown during the exposure."""

from __future__ import annotations

import math
from typing import cast

import torch
from torch import Tensor, nn

from kornia_tidy.checks import check_positive
from kornia_tidy.optics.materials import Material, constant_index
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH

MASK_SPAN = 2.3  # pupil radii across a mask: the paper's 23 pixels of a tenth of a radius


def metres_to_radians(material: Material, wavelength: float = REFERENCE_WAVELENGTH) -> float:
    """Return the phase in radians that one metre of a material adds over air.

    Args:
        material: the element's refractive index.
        wavelength: in metres.

    Source: Goodman, Introduction to Fourier Optics, section 6.1.

    Example:
        >>> round(metres_to_radians(constant_index(1.5)) * 1e-8, 4)
        0.0593
    """
    return 2 * math.pi * (material.index(wavelength) - 1) / wavelength


class PhaseMasks(nn.Module):
    """K height maps held as radians of phase at 530 nm. The kinds of mask below differ in how they make the phase.

    Metres (order 1e-7) would be lost in half precision and to weight decay; radians are of order one.

    Args:
        material: refractive index of the element.

    Shape:
        - ``phase``: (K, N, N) radians at 530 nm.
        - ``heights()``: (K, N, N) metres.

    Convention:
        - Axes are (mask, y, x), seen in the orientation of the image: a phase that rises along +x moves the PSF
          towards +x (columns to the right), one that rises along +y moves it down.
        - N pixels span 2.3 pupil radii; rho = 1 is the edge of the aperture.
    """

    phase: Tensor

    def __init__(self, material: Material | None = None) -> None:
        super().__init__()
        self.material = constant_index(1.5) if material is None else material

    def heights(self) -> Tensor:
        """Return the height maps in metres, (K, N, N); at least float32, since they are of order 1e-7."""
        phase = self.phase.to(torch.promote_types(self.phase.dtype, torch.float32))
        return phase / metres_to_radians(self.material)

    def dispersion(self, wavelength: float) -> float:
        """Return the factor from phase at 530 nm to phase at a wavelength in metres: colour and the element's index."""
        return metres_to_radians(self.material, wavelength) / metres_to_radians(self.material)

    def extra_repr(self) -> str:
        """Describe the masks in a person's words."""
        masks, size = self.phase.shape[0], self.phase.shape[-1]
        learnable = "learnable" if self.phase.requires_grad else "fixed"
        return f"{masks} {learnable} mask{'s' if masks != 1 else ''} of {size}x{size} pixels, {self.material.name}"


class PixelwiseMask(PhaseMasks):
    r"""Masks with one free height for each pixel of the modulator.

    Args:
        num_masks: number K of masks shown one after the other during the exposure.
        size: pixels N along a side.
        initial: ``"noise"`` (heights uniform on [0, 1.2e-6] m, the paper's start), ``"flat"``, or heights in metres
            as a (K, N, N) or (N, N) tensor, which then gives ``num_masks`` and ``size``.
        material: refractive index of the element. Default: 1.5 at every wavelength, as in the paper.
        generator: source of the noise.

    Shape:
        - ``phase``: learnable parameter (K, N, N).

    Raises:
        ValueError: if a size is not positive, or given heights are not finite square maps.

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
        size: int = 23,
        initial: str | Tensor = "noise",
        material: Material | None = None,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__(material)
        to_radians = metres_to_radians(self.material)
        if isinstance(initial, Tensor):
            heights = initial[None] if initial.ndim == 2 else initial
            if heights.ndim != 3 or heights.shape[-1] != heights.shape[-2] or heights.shape[0] == 0:
                raise ValueError(f"initial heights must have shape (K, N, N) or (N, N), got {tuple(initial.shape)}")
            if not bool(torch.isfinite(heights).all()):
                raise ValueError("initial heights must be finite metres, got NaN or infinity")
            phase = (heights.detach().double() * to_radians).to(torch.get_default_dtype())
        else:
            check_positive("num_masks", num_masks)
            check_positive("size", size)
            if initial not in ("noise", "flat"):
                raise ValueError(f"initial must be 'noise', 'flat' or heights in metres, got {initial!r}")
            phase = torch.zeros(num_masks, size, size)
            if initial == "noise":
                phase = torch.rand(phase.shape, generator=generator) * (self.NOISE_HEIGHT * to_radians)
        self.phase = nn.Parameter(phase)


class FresnelLens(PhaseMasks):
    r"""A fixed diffractive lens: quadratic phase wrapped at one wavelength. The paper's baseline without learning.

    .. math:: h(\rho) = \frac{\lambda_0}{2\pi (n - 1)} \left[ \psi_F \rho^2 \bmod 2\pi \right]

    It moves the focus by :math:`-\psi_F` at 530 nm, and by other amounts at other colours, which is its use.

    Args:
        defocus: strength :math:`\psi_F` in radians at the edge of the pupil. The paper does not state its value; 10
            is the strongest round number whose phase steps by less than :math:`\pi` between pixels of the 23x23 mask.
        size: pixels N along a side.
        material: refractive index of the element. Default: 1.5 at every wavelength.

    Shape:
        - ``phase``: fixed (1, N, N).

    Source: Shah et al., TiDy-PSFs (ICCV 2023), section 5 (the baseline named "0 phase masks").

    Example:
        >>> lens = FresnelLens()
        >>> float(lens.phase.max()) <= 2 * math.pi, list(lens.parameters())
        (True, [])
    """

    def __init__(self, defocus: float = 10.0, size: int = 23, material: Material | None = None) -> None:
        super().__init__(material)
        x = mask_coordinates(size)
        quadratic = defocus * (x[:, None] ** 2 + x[None, :] ** 2)
        self.register_buffer("phase", quadratic.remainder(2 * math.pi)[None].to(torch.get_default_dtype()))


def mask_coordinates(size: int) -> Tensor:
    """Return the centres of a mask's pixels along one axis in pupil radii, (N,) float64.

    Example:
        >>> mask_coordinates(23)[[0, 11, 22]]
        tensor([-1.1000,  0.0000,  1.1000], dtype=torch.float64)
    """
    check_positive("size", size)
    return (torch.arange(size, dtype=torch.float64) - (size - 1) / 2) * (MASK_SPAN / size)


def adam_groups(masks: nn.Module, lr_metres: float, **options: float) -> dict[str, object]:
    """Return the optimiser group of a mask whose learning rate is quoted in metres of height.

    Gradients per radian are small (median 2.5e-8 on a point-PSF task), so Adam's default eps of 1e-8 would damp
    them by a third; 1e-15 does not.

    Args:
        masks: module with a ``material`` and its parameters in radians.
        lr_metres: height that one Adam step moves, in metres.
        options: further settings of the group.

    Returns:
        Dictionary with ``params``, ``lr`` in radians, ``eps`` and the options.

    Example:
        >>> round(adam_groups(PixelwiseMask(), 1e-8)["lr"], 4)
        0.0593
    """
    check_positive("lr_metres", lr_metres, "metres")
    material = cast("PhaseMasks", masks).material
    return {
        "params": list(masks.parameters()),
        "lr": lr_metres * metres_to_radians(material),
        "eps": 1e-15,
        **options,
    }
