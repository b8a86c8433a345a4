r"""Aperture shapes: pupil amplitude on a grid of square cells.

All maps share one grid: ``size`` x ``size`` square cells around the optical axis, with centres at
(i - (size - 1)/2) * pitch. Lengths are in pupil radii, so ρ = 1 is the edge of the standard aperture. Row i is y,
column j is x, and y grows downwards as in an image. A shape larger than the grid is cropped.
"""

from __future__ import annotations

import math
from typing import Any, Literal

import torch
from torch import Tensor, nn

from kornia_tidy.checks import check_choice, check_positive, check_values, unmasked

Edges = Literal["binary", "area"]

TOLERANCE = 1e-9  # pupil radii; keeps cells open if their centre is on the rim, such as (0.6, 0.8), despite rounding


class OpenArea(Tensor):
    """The open fraction of each cell of an aperture with a hard edge, as ``edges="area"`` gives it.

    The edge shades no light: it crosses a cell. The field of the cell is that of its open part, so that the fraction
    is its mean amplitude; the light through the cell is the fraction too, and not its square, as through a graded
    filter (apodisation). A result computed from it, such as ``0.9 * aperture``, is a plain tensor of amplitudes.

    Example:
        >>> half = torch.tensor([[0.5]]).as_subclass(OpenArea)
        >>> float(light_through(half)), float(light_through(half * 1.0))
        (0.5, 0.25)
    """

    __torch_function__ = nn.Parameter.__torch_function__  # results are plain tensors

    def __deepcopy__(self, memo: dict[int, Any]) -> OpenArea:
        """Return a copy that is still one."""
        memo[id(self)] = copied = self.detach().clone().as_subclass(OpenArea)
        return copied


def light_through(aperture: Tensor) -> Tensor:
    """Return the light through each cell of an aperture: the open area of an :class:`OpenArea`, else amplitude squared.

    Args:
        aperture: amplitudes in [0, 1], or an :class:`OpenArea`.

    Returns:
        Fraction of the light that falls on the cell, a plain tensor in float64.
    """
    return aperture.as_subclass(Tensor).double() if isinstance(aperture, OpenArea) else aperture.double().square()


def circular_aperture(size: int, pitch: float = 0.1, radius: float = 1.0, *, edges: Edges = "binary") -> Tensor:
    """Return the amplitude of a round pupil.

    Args:
        size: cells along a side of the grid.
        pitch: side of a cell in pupil radii.
        radius: radius of the disc in pupil radii.
        edges: "binary" opens each cell with its centre within the disc (for a modulator with open or shut cells);
            "area" gives each cell the exact fraction of its area covered by the disc (for a smooth iris).

    Returns:
        Amplitude in [0, 1], float64; with "area" an :class:`OpenArea`.

    Shape:
        (size, size)

    Raises:
        ValueError: if a length is not positive, ``edges`` is unknown, or no cell is open.

    Source: Wu et al., PhaseCam3D, ICCP 2019: 23 cells of a tenth of the pupil radius, 317 of them open.

    Example:
        >>> int(circular_aperture(23).sum())
        317
        >>> round(circular_aperture(23, edges="area").sum().item() * 0.1**2, 12) == round(math.pi, 12)
        True
    """
    _check_grid(size, pitch, edges)
    check_positive("radius", radius, "pupil radii")
    return _made(_disc(size, pitch, radius, edges), edges)


def annular_aperture(size: int, pitch: float, inner: float, radius: float = 1.0, *, edges: Edges = "binary") -> Tensor:
    """Return the amplitude of a ring: a disc with a central obstruction.

    Args:
        size: cells along a side of the grid.
        pitch: side of a cell in pupil radii.
        inner: radius of the obstruction in pupil radii, between 0 and ``radius``.
        radius: outer radius in pupil radii.
        edges: "binary" or "area", see :func:`circular_aperture`.

    Returns:
        Amplitude in [0, 1], float64: the disc minus the obstruction. With "area" an :class:`OpenArea`.

    Shape:
        (size, size)

    Raises:
        ValueError: if a length is out of range, ``edges`` is unknown, or no cell is open.

    Example:
        >>> int(annular_aperture(23, 0.1, inner=0.5).sum())
        236
    """
    _check_grid(size, pitch, edges)
    check_positive("radius", radius, "pupil radii")
    if not 0 < inner < radius:
        raise ValueError(f"inner must be between 0 and the outer radius {radius}, got {inner}")
    return _made((_disc(size, pitch, radius, edges) - _disc(size, pitch, inner, edges)).clamp(min=0), edges)


def check_aperture(aperture: Any, size: int) -> Tensor:
    """Check a custom aperture and return it as float64.

    Args:
        aperture: amplitude in [0, 1], a real or boolean tensor, or anything that :func:`torch.as_tensor` reads.
        size: cells along a side of the pupil grid.

    Returns:
        A copy in float64 on the same device; of an :class:`OpenArea` another one.

    Shape:
        (size, size), or (K, size, size) for K masks

    Raises:
        TypeError: if the values are complex.
        ValueError: if the shape differs, a value is outside [0, 1] or NaN, or all are zero, those of a mask too.

    Example:
        >>> check_aperture([[True, False], [True, True]], 2)
        tensor([[1., 0.],
                [1., 1.]], dtype=torch.float64)
    """
    aperture = torch.as_tensor(unmasked("aperture", aperture))
    if aperture.is_complex():
        raise TypeError(f"aperture must be a real amplitude (its phase belongs to the mask), got {aperture.dtype}")
    each = aperture.ndim == 3 and len(aperture) and not isinstance(aperture, OpenArea)
    if tuple(aperture.shape[1:] if each else aperture.shape) != (size, size):
        raise ValueError(
            f"aperture must have shape ({size}, {size}), or (K, {size}, {size}) with amplitudes for K masks, got "
            f"{tuple(aperture.shape)}"
        )
    check_values("aperture", aperture)
    amplitude = aperture.to(torch.float64, copy=True)  # later edits of the user's array change nothing
    valid = (amplitude >= 0) & (amplitude <= 1)  # False for NaN too
    if not bool(valid.all()):
        raise ValueError(f"aperture must have amplitudes in [0, 1], got {amplitude[~valid][0].item()}")
    return _made(amplitude, "area" if isinstance(aperture, OpenArea) else "binary")


def _check_grid(size: int, pitch: float, edges: str) -> None:
    if size != int(size) or size < 1:
        raise ValueError(f"size must be a whole number of at least 1, got {size}")
    check_positive("pitch", pitch, "pupil radii")
    check_choice("edges", edges, ("binary", "area"))


def _made(amplitude: Tensor, edges: str) -> Tensor:
    """Return the aperture, or raise if every cell is closed: such a pupil has no point spread function."""
    check_values("aperture", amplitude)
    if not bool((amplitude > 0).flatten(-2).any(-1).all()):
        raise ValueError("aperture must let some light through, got 0 open cells")
    return amplitude.as_subclass(OpenArea) if edges == "area" else amplitude


def _cell_centres(size: int, pitch: float) -> Tensor:
    return (torch.arange(size, dtype=torch.float64) - (size - 1) / 2) * pitch


def _grid_lines(size: int, pitch: float) -> Tensor:
    """Return the size + 1 coordinates of the cell boundaries."""
    return (torch.arange(size + 1, dtype=torch.float64) - size / 2) * pitch


def _disc(size: int, pitch: float, radius: float, edges: str) -> Tensor:
    centres = _cell_centres(size, pitch)
    if edges == "binary":
        return (torch.hypot(centres[:, None], centres) <= radius + TOLERANCE).double()
    return disc_cover(size, pitch, radius)


def disc_cover(size: int, pitch: float, radius: float) -> Tensor:
    """Return the share of each cell's area that a centred disc covers, (size, size) float64.

    Example:
        >>> disc_cover(3, 1.0, 0.5).sum()  # pi / 4
        tensor(0.7854, dtype=torch.float64)
    """
    centres = _cell_centres(size, pitch)
    corner_areas = _disc_area_up_to(_grid_lines(size, pitch), radius)
    cover = corner_areas.diff(dim=0).diff(dim=1) / pitch**2
    # The differences leave round-off of 1e-16 / pitch², so cells wholly inside or outside are set to 1 or 0.
    nearest, farthest = (centres.abs() - pitch / 2).clamp(min=0), centres.abs() + pitch / 2
    cover[torch.hypot(farthest[:, None], farthest) <= radius] = 1
    cover[torch.hypot(nearest[:, None], nearest) >= radius] = 0
    return cover.clamp(0, 1)


def _disc_area_up_to(lines: Tensor, radius: float) -> Tensor:
    """Return the area of the disc within the rectangle from the centre to each crossing (y, x) of two lines.

    The area changes sign with y and with x. In the first quadrant it is x y while the corner (x, y) lies within the
    disc. For a corner outside, it is the integral of min(y, sqrt(r² - x²)):
    (x sqrt(r² - x²) + y sqrt(r² - y²) + r² (asin(x/r) + asin(y/r) - π/2)) / 2.
    The arcsine is taken as atan2(x, sqrt(r² - x²)): near the rim it would make 1e-8 of the rounding of x/r.
    """
    distance = lines.abs().clamp(max=radius)
    height = ((radius - distance) * (radius + distance)).sqrt()
    half_sector = distance * height + radius**2 * torch.atan2(distance, height)
    curved = (half_sector[:, None] + half_sector - radius**2 * math.pi / 2) / 2
    straight = distance[:, None] * distance
    inside = torch.hypot(distance[:, None], distance) <= radius
    return torch.where(inside, straight, curved) * lines.sign()[:, None] * lines.sign()
