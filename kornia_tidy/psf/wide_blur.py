r"""Wide blur: layers, windows and grids for the discs of a fast lens without a mask.

Where a pixel is wider than the diffraction pattern, a PSF depends on the radius r of the defocus disc in pixels, not on
radians of phase. Layers then stand 0.1 pixels of r apart near focus, where a disc grows beyond its first pixel, and
farther apart for larger discs,

.. math:: \Delta r = 0.4 \, (r / 3)^{3/4} \text{ for } r > 1.5,

because a change of a large disc is spread over its long edge. Discs of 24 pixels and more are smooth: their layers are
convolved on a grid of 2, 4, 8, ... pixels, on which the radius is between 12 and 24. Errors are given in
:data:`GRID_ERROR`, :data:`LAYER_ERROR` and :func:`ray_error`, root mean square for a scene with a standard deviation of
0.19 of full scale (the Aloe scene), in linear light.

All three arise at the edges of a PSF, which is an image of the aperture. Other apertures than the disc have longer
edges, or edges that move farther with defocus. Their layers stand closer, and rays and grids begin at larger radii, by
the factors of :class:`EdgeFactors`, so that the errors are those of the disc.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch.nn.functional import pad

from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH
from kornia_tidy.psf.geometric_psf import blur_radius
from kornia_tidy.psf.pupil import Pupil

LAYER_ERROR = 4.5e-4  # measured for discs of 0 to 50 px; half way between layers, which is the worst
GRID_ERROR = 3.5e-4  # measured where the radius is 12 pixels of the grid; 1.5e-4 where it is 24
RAY_TOLERANCE = 8e-4  # error of the geometric PSF from which on it is taken
FINE_RADIUS = 24.0  # pixels; up to here layers are convolved on the sensor's own pixels
SMALLEST_WIDE_RADIUS = 18.0  # pixels; lenses with smaller discs keep evenly spaced layers
_MARGIN = 6.0  # cycles per pupil radius around the disc: holds 98 % of the light or more, also in focus
_NEAR_SPACING = 0.1  # pixels of the radius, between layers near focus
_NEAR_RADIUS = 1.5  # pixels; layers of larger discs are farther apart
_SPACING, _RADIUS = 0.4, 3.0  # pixels between layers of larger discs, at this radius
_DISC_LENGTH, _DISC_SHIFT = 0.8359, 0.4796  # of the disc on 23 cells


@dataclass(frozen=True)
class EdgeFactors:
    r"""How long the edges of an aperture are for its light, and how far they move with defocus.

    With the jumps :math:`|\Delta t|` of the transmission between cells of side a, at the distance x from the axis along
    the edge's normal, the light :math:`A = \sum t a^2` and the same sums of the disc,

    .. math:: l = \frac{\sum |\Delta t| a}{A^2}, \qquad m = \frac{\sum |\Delta t| |x|^3 a}{A^2}.

    The image of an edge is off by a profile. An error of a scene with a spectrum of :math:`1 / f^2` grows with the
    length of the edges and, from layers, with the third power of their shift: mean squares go with l and m.

    Args:
        length: l over that of the disc.
        shift: m over that of the disc.

    Example:
        >>> from kornia_tidy.optics.aperture import annular_aperture, circular_aperture
        >>> for aperture in (circular_aperture(23), annular_aperture(23, 0.1, 0.5)):
        ...     edges = EdgeFactors.of(Pupil(aperture, 0.1))
        ...     print(round(edges.length, 2), round(edges.shift, 2))
        1.0 1.0
        2.75 1.92
    """

    length: float
    shift: float

    @classmethod
    def of(cls, pupil: Pupil) -> EdgeFactors:
        """Return the edges of an aperture."""
        light = pad(pupil.transmission.cpu(), (1, 1, 1, 1))
        at = (
            torch.arange(light.shape[-1] - 1, dtype=torch.float64) - (light.shape[-1] - 2) / 2
        ).abs() * pupil.cell_pitch
        length = shift = 0.0
        for jumps in (light.diff(dim=1), light.diff(dim=0).mT):
            length += float(jumps.abs().sum())
            shift += float((jumps.abs() * at**3).sum())
        scale = pupil.cell_pitch / float(pupil.transmission.sum() * pupil.cell_pitch**2) ** 2
        return cls(length * scale / _DISC_LENGTH, shift * scale / _DISC_SHIFT)


@dataclass(frozen=True)
class BlurGroup:
    """Layers that are convolved on the same grid.

    Args:
        grid: sensor pixels along a side of a pixel of the grid.
        nodes: defocus of the layers in radians, ascending. Neighbouring groups share a node.
        window: side of the PSFs in pixels of the grid, odd.
    """

    grid: int
    nodes: tuple[float, ...]
    window: int


@dataclass(frozen=True)
class WideBlur:
    """Layers of wide blur, in groups of ascending defocus.

    Args:
        groups: see :class:`BlurGroup`.
        window: side in sensor pixels that holds the PSFs of all layers.
        ray_radius: radius of the disc in pixels from which on PSFs are geometric.
        error: root mean square error of an image, from layers, grids and rays, see the module.
    """

    groups: tuple[BlurGroup, ...]
    window: int
    ray_radius: float
    error: float

    @property
    def nodes(self) -> tuple[float, ...]:
        """Defocus of all layers in radians, ascending."""
        return tuple(sorted({psi for group in self.groups for psi in group.nodes}))


def ray_error(radius: float, step: float, length: float = 1.0) -> float:
    r"""Return the error of an image through a geometric-optics PSF, :math:`0.0065 \, (\lambda_0 / s) \sqrt{l / r}`.

    Fitted to exact PSFs of f/1.4 to f/5.6 on pixels of 6 um, and discs of 4 to 50 px: measured errors are 0.6 to 1.2
    times the formula.

    Args:
        radius: r of the disc in pixels.
        step: s, a sensor pixel seen from the pupil in metres.
        length: l of the aperture's edges, see :class:`EdgeFactors`.

    Example:
        >>> round(ray_error(20.0, 1.63e-6), 5)  # measured at f/1.8: 5.4e-4
        0.00047
    """
    return 6.5e-3 * REFERENCE_WAVELENGTH / step * math.sqrt(length / radius)


def blurs_widely(defocus_range: tuple[float, float], step: float) -> bool:
    """Return whether rays describe the blur of a lens: its pixels are wider than the wave, and its discs large.

    Args:
        defocus_range: in radians.
        step: a sensor pixel seen from the pupil in metres.

    Example:
        >>> blurs_widely((-572.0, 572.0), 1.625e-6), blurs_widely((-20.0, 20.0), 2.1e-7)
        (True, False)
    """
    largest = max(abs(psi) for psi in defocus_range)
    return step >= REFERENCE_WAVELENGTH and blur_radius(largest, step) >= SMALLEST_WIDE_RADIUS


def wide_blur(defocus_range: tuple[float, float], step: float, pupil: Pupil) -> WideBlur:
    """Return the layers of wide blur, with their grids and windows.

    Args:
        defocus_range: in radians.
        step: a sensor pixel seen from the pupil in metres.
        pupil: the aperture.

    Example:
        >>> from kornia_tidy.optics.aperture import circular_aperture
        >>> blur = wide_blur((-572.0, 572.0), 1.625e-6, Pupil(circular_aperture(23), 0.1))
        >>> [group.grid for group in blur.groups], blur.window, len(blur.nodes)
        ([4, 2, 1, 2, 4], 131, 111)
    """
    lo, hi = defocus_range
    per_pixel = math.pi * step / REFERENCE_WAVELENGTH  # radians of defocus for a pixel of radius
    edges = EdgeFactors.of(pupil)
    ray_radius = (ray_error(1.0, step, edges.length) / RAY_TOLERANCE) ** 2
    finest = FINE_RADIUS * max(1.0, edges.length) ** (1 / 3)
    far, near = (_radii(max(0.0, end) / per_pixel, finest, edges.shift) for end in (-lo, hi))
    radii = sorted({*(-r for r in far), *near})
    radii = [r for r in radii if lo - 1e-9 <= r * per_pixel <= hi + 1e-9] or [lo / per_pixel, hi / per_pixel]
    radii[0], radii[-1] = lo / per_pixel, hi / per_pixel
    groups = []
    first = 0
    while first < len(radii) - 1:
        grid, last = _grid(radii[first], radii[first + 1], finest), first + 1
        while last < len(radii) - 1 and _grid(radii[last], radii[last + 1], finest) == grid:
            last += 1
        largest = max(abs(radii[first]), abs(radii[last]))
        nodes = tuple(r * per_pixel for r in radii[first : last + 1])
        groups.append(BlurGroup(grid, nodes, window_of(largest, step, pupil.extent, grid)))
        first = last
    window = window_of(max(-radii[0], radii[-1]), step, pupil.extent)
    least = max(ray_radius, 1.0)
    rays = min(RAY_TOLERANCE, ray_error(least, step, edges.length))
    error = math.sqrt(LAYER_ERROR**2 + GRID_ERROR**2 + rays**2)
    return WideBlur(tuple(groups), window, ray_radius, error)


def window_of(radius: float, step: float, extent: float, grid: int = 1) -> int:
    """Return the side of the window that holds a disc and the light diffracted around it, in pixels of a grid.

    Args:
        radius: of the disc in sensor pixels.
        step: a sensor pixel seen from the pupil in metres.
        extent: half width of the open pupil in pupil radii.
        grid: sensor pixels along a side of a pixel of the grid.

    Example:
        >>> window_of(53.7, 1.625e-6, 1.05), window_of(53.7, 1.625e-6, 1.05, 4)
        (119, 33)
    """
    reach = radius * extent + _MARGIN * REFERENCE_WAVELENGTH / step
    return 2 * math.ceil(reach / grid if grid == 1 else reach / grid + 0.5) + 1


def _radii(largest: float, finest: float, shift: float) -> list[float]:
    """Return radii of discs from 0 to the largest; where the grid changes there is one."""
    found, breaks = [0.0], [finest]
    while breaks[-1] < largest:
        breaks.append(2 * breaks[-1])
    far_spacing = _SPACING / shift ** (1 / 3)
    near = max(_NEAR_RADIUS, _RADIUS * (_NEAR_SPACING / far_spacing) ** (4 / 3))

    def count(radius: float) -> float:  # of layers up to a radius: the integral of 1 / dr
        inside = min(radius, near) / _NEAR_SPACING
        return inside + 4 * (max(radius, near) ** 0.25 - near**0.25) * _RADIUS**0.75 / far_spacing

    def radius_of(layers: float) -> float:
        if layers <= count(near):
            return layers * _NEAR_SPACING
        return (near**0.25 + (layers - count(near)) * far_spacing / (4 * _RADIUS**0.75)) ** 4

    for end in [b for b in breaks if b < largest] + [largest]:
        start, steps = count(found[-1]), count(end) - count(found[-1])
        intervals = max(1, math.ceil(steps - 1e-9))
        found += [radius_of(start + steps * i / intervals) for i in range(1, intervals)] + [end]
    return found


def _grid(one: float, other: float, finest: float) -> int:
    """Return the grid on which the discs between two radii are convolved."""
    middle, grid = abs(one + other) / 2, 1
    while middle >= finest * grid:
        grid *= 2
    return grid
