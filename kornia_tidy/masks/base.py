"""Base class of phase masks: phase in radians, pixel grid, height limits, and learning rates in metres of height."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, cast

import torch
from torch import Tensor, nn

from kornia_tidy.checks import check_choice, check_generator, check_metres, check_positive, described
from kornia_tidy.masks.limits import CONSTRAINTS, limited_phase
from kornia_tidy.optics.materials import Material, constant_index
from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH

MASK_SPAN = 2.3  # pupil radii along a mask's shorter side: 23 pixels of a tenth of a radius, as in the paper
NOISE_RMS = 2.05  # rad at 530 nm, as the paper's initial masks: heights uniform on [0, 1.2e-6] m at index 1.5
HEIGHTS = (1e-9, 1e-3)  # m; limits of ``max_height``
HEIGHT_STEPS = (1e-40, 1e-4)  # m; limits of a learning rate; a tiny one is harmless, a large one is a wrong unit

MOST_MASKS, MOST_PIXELS = 10_000, 2**28  # of a sequence, and of all its masks together: 1 GiB of float32

Size = int | tuple[int, int]
"""Pixels of a mask: along both sides, or (rows, columns)."""


def metres_to_radians(material: Material, wavelength: float = REFERENCE_WAVELENGTH) -> float:
    r"""Return the phase delay of one metre of a material relative to air, :math:`2\pi (n - 1) / \lambda`.

    Args:
        material: refractive index n of the element.
        wavelength: in metres.

    Returns:
        Radians at this wavelength for each metre of height.

    Source: Goodman, Introduction to Fourier Optics, section 6.1.

    Example:
        >>> round(metres_to_radians(constant_index(1.5)) * 1e-8, 4)
        0.0593
    """
    return 2 * math.pi * (material.index(wavelength) - 1) / wavelength


class PhaseMasks(nn.Module):
    r"""Base class of the mask families: K phase masks, with the phase in radians at 530 nm.

    Parameters are in radians, which are of order one. Metres, of order 1e-7, would suffer from half precision and
    weight decay. A family either registers a parameter or buffer named ``phase``, or computes :meth:`free_phase` from
    its own parameters.

    Args:
        material: refractive index of the element. Default: 1.5 at every wavelength, as in the paper.
        constraint: mapping of heights to the range from 0 to ``max_height``: ``"none"`` (default) has no limits;
            ``"clamp"`` clips the heights; ``"sigmoid"`` compresses them smoothly; ``"wrapped"`` takes the remainder, as
            in a diffractive lens. See :mod:`kornia_tidy.masks.limits`.
        max_height: in metres. Default: one wave at 530 nm, 1.06e-6 m at index 1.5.

    Shape:
        - ``phase``: (K, N, N) or (K, rows, columns), radians at 530 nm with the constraint applied.
        - ``heights()``: the same in metres.

    Raises:
        ValueError: if the constraint is unknown, or ``max_height`` is not between 1 nm and 1 mm, or it is given without
            a constraint.

    Convention:
        - Axes are (mask, y, x) in the orientation of the image: a phase that increases along +x moves the PSF towards
          +x (columns to the right); one that increases along +y moves it down.
        - Pixels are square, and the shorter side spans 2.3 pupil radii; rho = 1 is the edge of the aperture. Of a
          longer side, only the central part of that length is in the pupil.
        - The phase is constant over a pixel: the value of the family's formula at the pixel's centre.
        - "clamp" and "sigmoid" map a free phase of 0 to half of ``max_height``, so that it can move both ways.
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
        """Phase with the constraint applied, (K, N, N) radians at 530 nm."""
        free = self.free_phase()
        return free if self.constraint == "none" else limited_phase(free, self.constraint, self.max_phase)

    def free_phase(self) -> Tensor:
        """Return the phase before the constraint: here the parameter or buffer registered as ``phase``."""
        return cast("Tensor", super().__getattr__("phase"))  # AttributeError if a family registered none

    @classmethod
    def arguments_of(cls, parameters: Mapping[str, Tensor]) -> dict[str, Any]:
        """Return the arguments of the class that follow from the shapes of a state's parameters, such as ``num_masks``.

        Pixels, material and limits are no parameters; see :func:`~kornia_tidy.camera.saved_parts.masks_of_state`.

        Args:
            parameters: of a ``state_dict`` of these masks.

        Example:
            >>> PhaseMasks.arguments_of({"phase": torch.zeros(5, 23, 23)})
            {'num_masks': 5}
        """
        return {"num_masks": len(next(iter(parameters.values())))}

    def heights(self) -> Tensor:
        """Return the height maps in metres, (K, N, N), in float32 or better because they are of order 1e-7."""
        phase = self.phase
        return phase.to(torch.promote_types(phase.dtype, torch.float32)) / metres_to_radians(self.material)

    @property
    def iris(self) -> Tensor | None:
        """Default aperture of the camera; None: the pixels with centres in the disc."""
        return None

    def is_flat(self) -> bool:
        """Return whether each mask has one height everywhere, so that the camera is only a lens.

        Example:
            >>> from kornia_tidy import PixelwiseMask
            >>> PixelwiseMask(2, initial="flat").is_flat(), PixelwiseMask(2).is_flat()
            (True, False)
        """
        phase = self.phase.detach()
        return bool((phase == phase[:, :1, :1]).all())

    def dispersion(self, wavelength: float) -> float:
        """Return the ratio of the phase at a wavelength in metres to the phase at 530 nm, index included."""
        return metres_to_radians(self.material, wavelength) / metres_to_radians(self.material)

    def extra_repr(self) -> str:
        """Return a one-line description of the masks."""
        try:
            masks, rows, columns = self.phase.shape
        except AttributeError:  # of the base class, or before a family has registered its parameters
            return "no masks yet"
        learnable = "learnable" if any(p.requires_grad for p in self.parameters()) else "fixed"
        limit = ""
        if self.constraint != "none":
            limit = f", {self.constraint} to {self.max_phase / metres_to_radians(self.material) * 1e6:.3g} um"
        pixels = f"{masks} {learnable} mask{'s' if masks != 1 else ''} of {rows}x{columns} pixels"
        return f"{pixels}, {self.material.name}{limit}"


def mask_coordinates(size: int, pitch: float | None = None) -> Tensor:
    """Return the pixel centres of a mask along one axis in pupil radii.

    Args:
        size: pixels N along the axis.
        pitch: distance between pixels in pupil radii. Default: 2.3 / size, that of a square mask.

    Returns:
        (N,) float64, symmetric about zero.

    Raises:
        ValueError: if the size is not positive.

    Example:
        >>> mask_coordinates(23)[[0, 11, 22]]
        tensor([-1.1000,  0.0000,  1.1000], dtype=torch.float64)
    """
    check_positive("size", size)
    return (torch.arange(size, dtype=torch.float64) - (size - 1) / 2) * (MASK_SPAN / size if pitch is None else pitch)


def mask_axes(size: Size) -> tuple[Tensor, Tensor]:
    """Return the pixel centres of a mask along y and x in pupil radii.

    Args:
        size: pixels along both sides, or (rows, columns); the shorter side spans 2.3 pupil radii.

    Returns:
        y of the rows, downwards, (rows, 1), and x of the columns, (columns,); float64.

    Raises:
        ValueError: if a size is not positive or too large, or one is odd and the other even (see
            :func:`central_square`).

    Example:
        >>> y, x = mask_axes((23, 45))
        >>> y.shape, x.shape, round(float(x[-1]), 2)
        (torch.Size([23, 1]), torch.Size([45]), 2.2)
    """
    rows, columns = (size, size) if isinstance(size, int) else size
    check_positive("size", min(rows, columns))
    if rows * columns > MOST_PIXELS:
        raise ValueError(f"a mask must have at most {MOST_PIXELS} pixels, got {rows} x {columns}")
    if (rows - columns) % 2:
        raise ValueError(f"rows and columns of a mask must both be odd or both even, got {rows} and {columns}")
    pitch = MASK_SPAN / min(rows, columns)
    return mask_coordinates(rows, pitch)[:, None], mask_coordinates(columns, pitch)


def check_number_of_masks(num_masks: int, pixels: int = 1) -> None:
    """Raise ``ValueError`` unless a number of masks is possible, before any of them is made.

    Args:
        num_masks: the number.
        pixels: of each mask.

    Example:
        >>> check_number_of_masks(5, 23 * 23)
    """
    check_positive("num_masks", num_masks)
    if not hasattr(num_masks, "__index__"):
        raise TypeError(f"num_masks must be a whole number, got {described(num_masks)}")
    if num_masks > MOST_MASKS or num_masks * pixels > MOST_PIXELS:
        raise ValueError(
            f"num_masks must be at most {min(MOST_MASKS, MOST_PIXELS // pixels)} for masks of {pixels} pixels, "
            f"got {num_masks}"
        )


def central_square(phase: Tensor) -> Tensor:
    """Return the central square of rectangular masks, which covers the pupil.

    Args:
        phase: (K, rows, columns), both odd or both even, so that the square consists of whole pixels.

    Returns:
        (K, N, N) with N the shorter side; a view of ``phase``.

    Example:
        >>> central_square(torch.arange(5.0).reshape(1, 1, 5))
        tensor([[[2.]]])
    """
    rows, columns = phase.shape[-2:]
    top, left = max(rows - columns, 0) // 2, max(columns - rows, 0) // 2
    return phase[..., top : rows - top, left : columns - left]


def gather_values(values: Tensor, index: Tensor) -> Tensor:
    """Gather for every pixel of each mask one of the mask's parameters, by an index map.

    Args:
        values: M parameters of each mask, (K, M).
        index: which of them a pixel takes, (N, N) int64, the same for all masks.

    Returns:
        (K, N, N).

    Example:
        >>> gather_values(torch.tensor([[1.0, 2.0]]), torch.tensor([[0, 1], [1, 1]]))
        tensor([[[1., 2.],
                 [2., 2.]]])
    """
    return values.index_select(1, index.flatten()).unflatten(1, index.shape)  # half the time of values[:, index]


def initial_values(
    initial: str | Tensor, num_masks: int, shape: tuple[int, ...], rms: float, generator: torch.Generator | None
) -> Tensor:
    """Return the initial parameters of a mask family, (K, *shape).

    Args:
        initial: ``"noise"`` (normally distributed), ``"flat"`` (zeros), or the values themselves, with or without the
            axis of masks.
        num_masks: number K of masks; ignored if values are given.
        shape: shape of the parameters of one mask.
        rms: root mean square of the noise.
        generator: source of the noise.

    Returns:
        Parameters in the default dtype, detached from any graph.

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
    check_number_of_masks(num_masks)
    check_choice("initial", initial, ("noise", "flat"))
    if initial == "flat":
        return torch.zeros(num_masks, *shape)
    noise = rms * torch.randn(num_masks, *shape, generator=generator, dtype=torch.float32)
    return noise.to(torch.get_default_dtype())  # another type draws other numbers


def adam_groups(masks: nn.Module, lr_metres: float, **options: float) -> dict[str, object]:
    """Return the Adam parameter group of masks for a learning rate in metres of height.

    Gradients per radian are small (median 2.5e-8 on a point-PSF task), so Adam's default eps of 1e-8 would reduce the
    steps by a third. The group has an eps of 1e-15.

    Args:
        masks: module with a ``material`` and its parameters in radians.
        lr_metres: change of each parameter in one Adam step, in metres. If a parameter is the height of a pixel or at
            a radius, the surface there moves by this much. If it is the coefficient of a polynomial or wave, the root
            mean square of that term changes by this much (Zernike over the pupil, Fourier over the mask), and M terms
            together move the surface by up to sqrt(M) times as much.
        options: further settings of the group.

    Returns:
        Dictionary with ``params``, ``lr`` in radians, ``eps`` and the options.

    Raises:
        ValueError: if ``lr_metres`` is not between 1e-40 and 1e-4.

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


def parameter_groups(
    module: nn.Module, masks: nn.Module, lr_metres: float, lr: float | None = None
) -> list[dict[str, object]]:
    """Return the Adam parameter groups of a module that has masks: theirs, then one of its other parameters.

    Args:
        module: with the masks as a submodule.
        masks: see :func:`adam_groups`.
        lr_metres: learning rate of the masks in metres of height.
        lr: learning rate of the other parameters. Default: the optimiser's.

    Example:
        >>> from kornia_tidy.masks.pixelwise import PixelwiseMask
        >>> len(parameter_groups(module := nn.ModuleList([PixelwiseMask(), nn.Linear(1, 1)]), module[0], 1e-8))
        2
    """
    of_masks = {id(parameter) for parameter in masks.parameters()}
    others = [parameter for parameter in module.parameters() if id(parameter) not in of_masks]
    groups = [adam_groups(masks, lr_metres)]
    if others:
        group: dict[str, object] = {"params": others}
        groups.append(group if lr is None else {**group, "lr": lr})
    return groups
