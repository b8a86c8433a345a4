"""What all phase masks share: their unit, their grid, their limits and the unit of their learning rate."""

from __future__ import annotations

import math
from typing import cast

import torch
from torch import Tensor, nn

from kornia_tidy.checks import check_choice, check_generator, check_metres, check_positive
from kornia_tidy.masks.limits import CONSTRAINTS, limited_phase
from kornia_tidy.optics.materials import Material, constant_index
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH

MASK_SPAN = 2.3  # pupil radii across a mask's shorter side: the paper's 23 pixels of a tenth of a radius
NOISE_RMS = 2.05  # radians at 530 nm: that of the paper's start, heights uniform on [0, 1.2e-6] m at index 1.5
HEIGHTS = (1e-9, 1e-3)  # m; what an element or a panel may be high
HEIGHT_STEPS = (1e-40, 1e-4)  # m; what a step of learning may move: next to nothing is no wrong unit

Size = int | tuple[int, int]
"""Pixels of a mask: along both sides, or (rows, columns)."""


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
    r"""K height maps held as radians of phase at 530 nm. The families of masks differ in how they make the phase.

    Metres (order 1e-7) would be lost in half precision and to weight decay; radians are of order one. A family either
    has a parameter or buffer named ``phase``, or computes :meth:`free_phase` from its own parameters.

    Args:
        material: refractive index of the element. Default: 1.5 at every wavelength, as in the paper.
        constraint: how heights are kept between 0 and ``max_height``: ``"none"`` (default) lets them be;
            ``"clamp"`` cuts them off; ``"sigmoid"`` bends them smoothly; ``"wrapped"`` takes the remainder, as in a
            diffractive lens. See :mod:`kornia_tidy.masks.limits`.
        max_height: in metres. Default: one wave at 530 nm, 1.06e-6 m at index 1.5.

    Shape:
        - ``phase``: (K, N, N) radians at 530 nm, or (K, rows, columns): the constraint is applied.
        - ``heights()``: the same in metres.

    Raises:
        ValueError: if the constraint is unknown, or the largest height not positive or given without a constraint.

    Convention:
        - Axes are (mask, y, x), seen in the orientation of the image: a phase that rises along +x moves the PSF
          towards +x (columns to the right), one that rises along +y moves it down.
        - The shorter side spans 2.3 pupil radii, pixels are square; rho = 1 is the edge of the aperture. Of a longer
          side, light passes only through as much in the middle.
        - Each pixel has one phase: that of the family's formula at the pixel's centre.
        - "clamp" and "sigmoid" raise a free phase of 0 to half of ``max_height``, so that shapes have room both ways.
    """

    def __init__(
        self, material: Material | None = None, constraint: str = "none", max_height: float | None = None
    ) -> None:
        super().__init__()
        check_choice("constraint", constraint, CONSTRAINTS)
        self.material = constant_index(1.5) if material is None else material
        if max_height is not None:
            check_metres("max_height", max_height, *HEIGHTS, "1 um is 1e-6")
            if constraint == "none":
                raise ValueError(f"max_height needs a constraint, 'clamp', 'sigmoid' or 'wrapped', got {max_height}")
        self.constraint = constraint
        self.max_phase = 2 * math.pi if max_height is None else max_height * metres_to_radians(self.material)

    @property
    def phase(self) -> Tensor:
        """The phase shown, (K, N, N) radians at 530 nm, within the limits of the constraint."""
        free = self.free_phase()
        return free if self.constraint == "none" else limited_phase(free, self.constraint, self.max_phase)

    def free_phase(self) -> Tensor:
        """Return the phase before the constraint: here the parameter or buffer registered as ``phase``."""
        return cast("Tensor", super().__getattr__("phase"))  # an AttributeError as long as none is registered

    def heights(self) -> Tensor:
        """Return the height maps in metres, (K, N, N); at least float32, since they are of order 1e-7."""
        phase = self.phase
        return phase.to(torch.promote_types(phase.dtype, torch.float32)) / metres_to_radians(self.material)

    def dispersion(self, wavelength: float) -> float:
        """Return the factor from phase at 530 nm to phase at a wavelength in metres: colour and the element's index."""
        return metres_to_radians(self.material, wavelength) / metres_to_radians(self.material)

    def extra_repr(self) -> str:
        """Describe the masks in a person's words."""
        masks, rows, columns = self.phase.shape
        learnable = "learnable" if any(p.requires_grad for p in self.parameters()) else "fixed"
        limit = ""
        if self.constraint != "none":
            limit = f", {self.constraint} to {self.max_phase / metres_to_radians(self.material) * 1e6:.3g} um"
        pixels = f"{masks} {learnable} mask{'s' if masks != 1 else ''} of {rows}x{columns} pixels"
        return f"{pixels}, {self.material.name}{limit}"


def mask_coordinates(size: int, pitch: float | None = None) -> Tensor:
    """Return the centres of a mask's pixels along one axis in pupil radii, (N,) float64.

    Args:
        size: pixels along the axis.
        pitch: distance between pixels in pupil radii. Default: that of a square mask, 2.3 / size.

    Example:
        >>> mask_coordinates(23)[[0, 11, 22]]
        tensor([-1.1000,  0.0000,  1.1000], dtype=torch.float64)
    """
    check_positive("size", size)
    return (torch.arange(size, dtype=torch.float64) - (size - 1) / 2) * (MASK_SPAN / size if pitch is None else pitch)


def mask_axes(size: Size) -> tuple[Tensor, Tensor]:
    """Return the centres of a mask's pixels in pupil radii: y down the rows (N, 1), and x along the columns (N,).

    Args:
        size: pixels along both sides, or (rows, columns); the shorter side spans 2.3 pupil radii.

    Raises:
        ValueError: if a size is not positive, or one is odd and the other even (see :func:`central_square`).

    Example:
        >>> y, x = mask_axes((23, 45))
        >>> y.shape, x.shape, round(float(x[-1]), 2)
        (torch.Size([23, 1]), torch.Size([45]), 2.2)
    """
    rows, columns = (size, size) if isinstance(size, int) else size
    check_positive("size", min(rows, columns))
    if (rows - columns) % 2:
        raise ValueError(f"rows and columns of a mask must both be odd or both even, got {rows} and {columns}")
    pitch = MASK_SPAN / min(rows, columns)
    return mask_coordinates(rows, pitch)[:, None], mask_coordinates(columns, pitch)


def central_square(phase: Tensor) -> Tensor:
    """Return the middle of masks that are longer along one axis: the square over the pupil, where the light passes.

    Args:
        phase: (K, rows, columns), both odd or both even, so that the square falls on whole pixels.

    Returns:
        (K, N, N) with N the shorter side; the same tensor where it is square.

    Example:
        >>> central_square(torch.arange(5.0).reshape(1, 1, 5))
        tensor([[[2.]]])
    """
    rows, columns = phase.shape[-2:]
    top, left = max(rows - columns, 0) // 2, max(columns - rows, 0) // 2
    return phase[..., top : rows - top, left : columns - left]


def spread(values: Tensor, place: Tensor) -> Tensor:
    """Return the values of each mask, (K, M), at the place each pixel names, (N, N): (K, N, N).

    Example:
        >>> spread(torch.tensor([[1.0, 2.0]]), torch.tensor([[0, 1], [1, 1]]))
        tensor([[[1., 2.],
                 [2., 2.]]])
    """
    return values.index_select(1, place.flatten()).unflatten(1, place.shape)  # half the time of values[:, place]


def initial_values(
    initial: str | Tensor, num_masks: int, shape: tuple[int, ...], rms: float, generator: torch.Generator | None
) -> Tensor:
    """Return the parameters that a family of masks starts from, (K, *shape).

    Args:
        initial: ``"noise"`` (normal, of this root mean square), ``"flat"`` (zeros), or the values themselves, with or
            without the axis of masks.
        num_masks: number K of masks; given values have their own.
        shape: of the parameters of one mask.
        rms: of the noise.
        generator: source of the noise.

    Raises:
        ValueError: if the name is unknown, or given values have another shape or are not finite.

    Example:
        >>> initial_values(torch.ones(4), 5, (4,), 1.0, None).shape
        torch.Size([1, 4])
    """
    if isinstance(initial, Tensor):
        values = initial[None] if initial.ndim == len(shape) else initial
        if tuple(values.shape[1:]) != shape or len(values) == 0:
            wanted = "(K, " + ", ".join(map(str, shape)) + ")"
            raise ValueError(f"initial values must have shape {wanted}, got {tuple(initial.shape)}")
        if not bool(torch.isfinite(values).all()):
            raise ValueError("initial values must be finite, got NaN or infinity")
        return values.detach().to(torch.get_default_dtype(), copy=True)
    check_generator(generator)
    check_positive("num_masks", num_masks)
    check_choice("initial", initial, ("noise", "flat"))
    if initial == "flat":
        return torch.zeros(num_masks, *shape)
    return rms * torch.randn(num_masks, *shape, generator=generator)


def adam_groups(masks: nn.Module, lr_metres: float, **options: float) -> dict[str, object]:
    """Return the optimiser group of a mask whose learning rate is quoted in metres of height.

    Gradients per radian are small (median 2.5e-8 on a point-PSF task), so Adam's default eps of 1e-8 would damp
    them by a third; 1e-15 does not.

    Args:
        masks: module with a ``material`` and its parameters in radians.
        lr_metres: height that one Adam step moves each parameter by, in metres. Where a parameter is a pixel or the
            height at a radius, that is how far the surface moves there. Where it is the strength of a shape, it is how
            far that shape's root mean square moves (Zernike over the pupil, Fourier over the mask), and M shapes
            together move the surface by up to sqrt(M) times as much.
        options: further settings of the group.

    Returns:
        Dictionary with ``params``, ``lr`` in radians, ``eps`` and the options.

    Example:
        >>> from kornia_tidy.masks.pixelwise import PixelwiseMask
        >>> round(adam_groups(PixelwiseMask(), 1e-8)["lr"], 4)
        0.0593
    """
    check_metres("lr_metres", lr_metres, *HEIGHT_STEPS, "10 nm is 10e-9")
    material = cast("PhaseMasks", masks).material
    return {
        "params": list(masks.parameters()),
        "lr": lr_metres * metres_to_radians(material),
        "eps": 1e-15,
        **options,
    }
