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
the factors of :func:`edge_factors`, so that the errors are those of the disc.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import groupby, pairwise

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


def edge_factors(pupil: Pupil) -> tuple[float, float]:
    r"""Return how long the edges of an aperture are for its light, and how far they move with defocus.

    With the jumps :math:`|\Delta t|` of the transmission between cells of side a, at the distance x from the axis along
    the edge's normal, the light :math:`A = \sum t a^2` and the same sums of the disc,

    .. math:: l = \frac{\sum |\Delta t| a}{A^2}, \qquad m = \frac{\sum |\Delta t| |x|^3 a}{A^2}.

    The image of an edge is off by a profile. An error of a scene with a spectrum of :math:`1 / f^2` grows with the
    length of the edges and, from layers, with the third power of their shift: mean squares go with l and m.

    Args:
        pupil: the aperture.

    Returns:
        Length l and shift m, each over that of the disc.

    Example:
        >>> from kornia_tidy.optics.aperture import annular_aperture, circular_aperture
        >>> for aperture in (circular_aperture(23), annular_aperture(23, 0.1, 0.5)):
        ...     print([round(factor, 2) for factor in edge_factors(Pupil(aperture, 0.1))])
        [1.0, 1.0]
        [2.75, 1.92]
    """
    light = pad(pupil.transmission.cpu(), (1, 1, 1, 1))
    edges = torch.arange(light.shape[-1] - 1, dtype=torch.float64) - (light.shape[-1] - 2) / 2
    jumps = torch.cat([light.diff(dim=1), light.diff(dim=0).mT]).abs()
    scale = pupil.cell_pitch / float(pupil.transmission.sum() * pupil.cell_pitch**2) ** 2
    length, shift = jumps.sum(), (jumps * (edges.abs() * pupil.cell_pitch) ** 3).sum()
    return float(length) * scale / _DISC_LENGTH, float(shift) * scale / _DISC_SHIFT


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
    """

    groups: tuple[BlurGroup, ...]
    window: int
    ray_radius: float

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
        length: l of the aperture's edges, see :func:`edge_factors`.

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
    length, shift = edge_factors(pupil)
    ray_radius = (ray_error(1.0, step, length) / RAY_TOLERANCE) ** 2
    finest = FINE_RADIUS * max(1.0, length) ** (1 / 3)
    far, near = (_radii(max(0.0, end) / per_pixel, finest, shift) for end in (-lo, hi))
    radii = sorted({*(-r for r in far), *near})
    radii = [r for r in radii if lo - 1e-9 <= r * per_pixel <= hi + 1e-9] or [lo / per_pixel, hi / per_pixel]
    radii[0], radii[-1] = lo / per_pixel, hi / per_pixel
    groups = []
    for grid, pairs in groupby(pairwise(radii), lambda pair: _grid(*pair, finest)):
        first, *rest = pairs
        own = (*first, *(radius for _, radius in rest))
        nodes = tuple(radius * per_pixel for radius in own)
        groups.append(BlurGroup(grid, nodes, window_of(max(map(abs, own)), step, pupil.extent, grid)))
    window = window_of(max(-radii[0], radii[-1]), step, pupil.extent)
    return WideBlur(tuple(groups), window, ray_radius)


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
    return 2 ** max(0, math.frexp(abs(one + other) / 2 / finest)[1])
