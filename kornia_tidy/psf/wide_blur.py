r"""Wide blur: layers, windows and grids for the discs of a fast lens without a mask.

Where a pixel is wider than the diffraction pattern, a PSF depends on the radius r of the defocus disc in pixels, not on
radians of phase. Layers then stand 0.4 pixels of r apart near focus, and farther apart for larger discs,

.. math:: \Delta r = 0.4 \max(1, r / 3)^{3/4},

because a change of a large disc is spread over its long edge. Discs of 24 pixels and more are smooth: their layers are
convolved on a grid of 2, 4, 8, ... pixels, on which the radius is between 12 and 24. Errors are given in
:data:`GRID_ERROR`, :data:`LAYER_ERROR` and :func:`ray_error`, root mean square for a scene whose standard deviation is
:data:`SCENE_DEVIATION` of full scale (the Aloe scene), in linear light.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from kornia_tidy.optics.spectrum import REFERENCE_WAVELENGTH
from kornia_tidy.psf.geometric_psf import blur_radius

LAYER_ERROR = 4.5e-4  # measured for discs of 2 to 50 px; half way between layers, which is the worst
GRID_ERROR = 3.5e-4  # measured where the radius is 12 pixels of the grid; 1.5e-4 where it is 24
RAY_TOLERANCE = 8e-4  # error of the geometric PSF from which on it is taken
SCENE_DEVIATION = 0.19  # standard deviation of the light for which the errors above were measured
FINE_RADIUS = 24.0  # pixels; up to here layers are convolved on the sensor's own pixels
SMALLEST_WIDE_RADIUS = 18.0  # pixels; lenses with smaller discs keep evenly spaced layers
_MARGIN = 6.0  # cycles per pupil radius around the disc: holds 98 % of the light or more, also in focus
_SPACING = 0.4  # pixels of the radius, between layers near focus
_LARGE_RADIUS = 3.0  # pixels; layers of larger discs are farther apart


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


def ray_error(radius: float, step: float) -> float:
    r"""Return the error of an image through a geometric-optics PSF, :math:`0.0065 \, (\lambda_0 / s) / \sqrt{r}`.

    Fitted to exact PSFs of f/1.4 to f/5.6 on pixels of 6 um, and discs of 4 to 50 px: measured errors are 0.6 to 1.2
    times the formula.

    Example:
        >>> round(ray_error(20.0, 1.63e-6), 5)  # measured at f/1.8: 5.4e-4
        0.00047
    """
    return 6.5e-3 * REFERENCE_WAVELENGTH / (step * math.sqrt(radius))


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


def wide_blur(defocus_range: tuple[float, float], step: float, extent: float) -> WideBlur:
    """Return the layers of wide blur, with their grids and windows.

    Args:
        defocus_range: in radians.
        step: a sensor pixel seen from the pupil in metres.
        extent: half width of the open pupil in pupil radii.

    Example:
        >>> blur = wide_blur((-572.0, 572.0), 1.625e-6, 1.05)
        >>> [group.grid for group in blur.groups], blur.window, len(blur.nodes)
        ([4, 2, 1, 2, 4], 131, 85)
    """
    lo, hi = defocus_range
    per_pixel = math.pi * step / REFERENCE_WAVELENGTH  # radians of defocus for a pixel of radius
    ray_radius = (ray_error(1.0, step) / RAY_TOLERANCE) ** 2
    far, near = _radii(max(0.0, -lo) / per_pixel), _radii(max(0.0, hi) / per_pixel)
    radii = sorted({*(-r for r in far), *near})
    radii = [r for r in radii if lo - 1e-9 <= r * per_pixel <= hi + 1e-9] or [lo / per_pixel, hi / per_pixel]
    radii[0], radii[-1] = lo / per_pixel, hi / per_pixel
    groups = []
    first = 0
    while first < len(radii) - 1:
        grid, last = _grid(radii[first], radii[first + 1]), first + 1
        while last < len(radii) - 1 and _grid(radii[last], radii[last + 1]) == grid:
            last += 1
        largest = max(abs(radii[first]), abs(radii[last]))
        nodes = tuple(r * per_pixel for r in radii[first : last + 1])
        groups.append(BlurGroup(grid, nodes, window_of(largest, step, extent, grid)))
        first = last
    window = window_of(max(-radii[0], radii[-1]), step, extent)
    least = max(ray_radius, 1.0)
    error = math.sqrt(LAYER_ERROR**2 + GRID_ERROR**2 + min(RAY_TOLERANCE, ray_error(least, step)) ** 2)
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


def _radii(largest: float) -> list[float]:
    """Return radii of discs from 0 to the largest; where the grid changes there is one."""
    found, breaks = [0.0], [FINE_RADIUS]
    while breaks[-1] < largest:
        breaks.append(2 * breaks[-1])
    for end in [b for b in breaks if b < largest] + [largest]:
        steps = _count(end) - _count(found[-1])
        intervals, start = max(1, math.ceil(steps - 1e-9)), found[-1]
        found += [_radius(_count(start) + steps * i / intervals) for i in range(1, intervals)] + [end]
    return found


def _count(radius: float) -> float:
    """Return the number of layers up to a radius: the integral of 1 / dr."""
    inside = min(radius, _LARGE_RADIUS) / _SPACING
    return inside + 4 * _LARGE_RADIUS * (max(1.0, radius / _LARGE_RADIUS) ** 0.25 - 1) / _SPACING


def _radius(count: float) -> float:
    inside = _LARGE_RADIUS / _SPACING
    if count <= inside:
        return count * _SPACING
    return _LARGE_RADIUS * (1 + (count - inside) * _SPACING / (4 * _LARGE_RADIUS)) ** 4


def _grid(one: float, other: float) -> int:
    """Return the grid on which the discs between two radii are convolved."""
    middle, grid = abs(one + other) / 2, 1
    while middle >= FINE_RADIUS * grid:
        grid *= 2
    return grid
