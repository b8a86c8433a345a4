r"""How many nodes over the field a lens needs, so that PSFs interpolated between them have a stated error.

A PSF is a sum over pairs of points of the stop,

.. math:: h(p) = \sum_{ab} U_a U_b^* \, e^{i (\phi_a(p) - \phi_b(p))}

with the phases of the rays that join stop and pixel. Polynomials over the field that interpolate the factors of all
pairs interpolate the PSF as well as these. A few pairs therefore predict the error of nodes, in milliseconds and for
any mask.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from functools import lru_cache

import torch
from torch import Tensor

from kornia_tidy.optics.default_device import on_cpu
from kornia_tidy.optics.lens.lens import Lens
from kornia_tidy.optics.lens.lens_table import LensTable
from kornia_tidy.optics.zernike import zernike_polynomials
from kornia_tidy.psf.field import Field, chebyshev_points, lagrange
from kornia_tidy.psf.lens_psfs import turned_lenses, wavefronts

MOST_NODES = 13  # along a side
CELLS = (16, 128)  # px along the side of the smallest and largest cell that sees PSFs change to first order
_KNOWN = 15  # Chebyshev points along a line at which phases are computed
_RINGS = ((0.0, 1), (0.5, 4), (0.9, 8))  # radius in the stop, and points there
# Error of PSFs over that of the factors of these pairs, as much light passes pairs that lie close together: measured at
# most .25 for five random masks and .39 for three, .3 to .7 for a bare lens, .47 and more for one mask.
_OF_PAIRS, _OF_PAIRS_OF_FEW = 0.4, 0.7
_FEW = 2
_LEAST = 1e-9  # error of a cell: less makes no cell smaller


@on_cpu
def field_nodes(
    size: tuple[int, int],
    center: tuple[float, float],
    lens: Lens,
    defocus: Sequence[float],
    wavelength: float,
    pixel_pitch: float,
    reach: float,
    tolerance: float,
    masks: int,
) -> Field:
    """Return the fewest nodes over a picture, and the largest cells, with a relative error of PSFs (L2) of a tolerance.

    Args:
        size: rows and columns of the picture in pixels.
        center: of the picture, y and x in pixels from the axis.
        lens: in front of the sensor.
        defocus: lowest and highest of the scene in radians at 530 nm.
        wavelength: the shortest, in metres.
        pixel_pitch: of the sensor in metres.
        reach: pixels from the PSF's middle within which most of its light falls.
        tolerance: relative error of the PSFs. A warning tells where :data:`MOST_NODES` leave more.
        masks: that are shown; 1 for a lens without masks. PSFs of one or two follow nodes less well.

    PSFs are taken as constant in cells in which their first order stays within the tolerance.

    Example:
        >>> lens, given = Lens.named("single-50mm", 17.6, 0.595), ((-20.0, 20.0), 470e-9, 8e-6, 10.0, 3e-2, 5)
        >>> whole = field_nodes((1110, 1282), (0.0, 0.0), lens, *given)
        >>> whole.nodes, whole.cell
        ((6, 7), 128)
        >>> field_nodes((64, 64), (0.0, 0.0), lens, *given).nodes
        (1, 1)
    """
    errors, slopes, bends = zip(
        *_along_axes(size, center, lens.table, tuple(defocus), wavelength, pixel_pitch, reach), strict=True
    )
    of_pairs = _OF_PAIRS_OF_FEW if masks <= _FEW else _OF_PAIRS
    errors = of_pairs * torch.hypot(errors[0][:, None], errors[1])
    if (beyond := float(errors[-1, -1])) > tolerance:
        warnings.warn(
            f"PSFs of the lens {lens.name!r} vary so much over {size[0]}x{size[1]} px that {MOST_NODES} places along a "
            f"side leave a relative error of {beyond:.2g}, more than the field_tolerance of {tolerance:.2g}: take a "
            f"smaller picture or aperture",
            UserWarning,
            stacklevel=3,
        )
    counts = torch.arange(1, MOST_NODES + 1)
    places = torch.where(errors <= max(tolerance, float(errors.min())), counts[:, None] * counts, MOST_NODES**2 + 1)
    rows, columns = divmod(int(places.argmin()), MOST_NODES)
    cell, still = cells_within(tolerance, max(slopes), max(bends))
    return Field(size, (rows + 1, columns + 1), center, cell=cell, still=still)


def cells_within(tolerance: float, slope: float, bend: float) -> tuple[int, int]:
    """Return the sides in pixels of the largest cells in which PSFs may be taken to first order, and as in the middle.

    Args:
        tolerance: of PSFs.
        slope: error of the middle's value in a cell, over its pixels.
        bend: error of the first order there, over the square of its pixels.

    Example:
        >>> cells_within(1e-2, 2e-4, 4e-6)
        (50, 50)
    """
    first, value = math.sqrt(tolerance / max(bend, _LEAST)), tolerance / max(slope, _LEAST)
    return max(CELLS[0], min(CELLS[1], int(first))), min(CELLS[1], int(value))


@lru_cache(maxsize=32)
def _along_axes(
    size: tuple[int, int],
    center: tuple[float, float],
    table: LensTable,
    defocus: tuple[float, ...],
    wavelength: float,
    pixel_pitch: float,
    reach: float,
) -> tuple[tuple[Tensor, float, float], ...]:
    """Return, along either axis, the error of the factors of all pairs for each number of nodes from one.

    And the error of their value in a cell over its pixels, and of their first order over the square of these.
    """
    with torch.inference_mode(False):
        found = []
        for axis in (0, 1):
            half, others = ((size[i] - 1) / 2 for i in (axis, 1 - axis))
            lines = []
            for beside in (-others, 0.0, others):
                points = [(center[axis] + half * x, center[1 - axis] + beside) for x in chebyshev_points(_KNOWN)]
                places = [point if axis == 0 else point[::-1] for point in points]
                lines.append(_errors(_phases(table, places, defocus, wavelength, pixel_pitch, reach)))
            errors, slopes, bends = zip(*lines, strict=True)
            length = max(2 * half, 1.0)
            found.append((torch.stack(errors).amax(0), max(slopes) / length, max(bends) / length**2))
        return tuple(found)


def _errors(phases: Tensor) -> tuple[Tensor, float, float]:
    """Return the error of the factors of all pairs for each number of nodes from one.

    And those of their value and of their first order in a cell as long as the line, were they to follow the first and
    the second order.
    """
    fine = torch.linspace(-1, 1, 4 * _KNOWN, dtype=torch.float64)

    def factors(places: Tensor) -> Tensor:
        own = torch.tensordot(lagrange(_KNOWN, places)[0], phases, 1)  # phases are smooth: they change by little
        return torch.polar(torch.ones_like(own), own)

    exact, errors = factors(fine), []
    for count in range(1, MOST_NODES + 1):
        nodes = factors(torch.tensor(chebyshev_points(count), dtype=torch.float64))
        between = torch.tensordot(lagrange(count, fine)[0].to(nodes.dtype), nodes, 1)
        errors.append(_largest(between - exact))
    second = exact.diff(n=2, dim=0) / float(fine[1] - fine[0]) ** 2  # f'' (x^2 - 1 / 3) / 2 is left, see Field.tiles
    bend = _largest(second) / math.sqrt(45)
    first = exact.diff(dim=0) / float(fine[1] - fine[0])  # f' x is left
    slope = _largest(first) / math.sqrt(3)
    return torch.tensor(errors, dtype=torch.float64), slope, bend


def _largest(factors: Tensor) -> float:
    """Return the root mean square over pairs, the largest along the line."""
    parts = torch.view_as_real(factors).flatten(1)
    return float(torch.linalg.vector_norm(parts, dim=1).max()) / math.sqrt(factors.shape[1])


def _phases(
    table: LensTable,
    field: Sequence[tuple[float, float]],
    defocus: Sequence[float],
    wavelength: float,
    pitch: float,
    reach: float,
) -> Tensor:
    """Return the phase between pairs of points of the stop, of several depths and pixels, (F, pairs) radians."""
    at = [(r * math.cos(t), r * math.sin(t)) for r, n in _RINGS for t in (2 * math.pi * i / n for i in range(n))]
    x, y = torch.tensor(at, dtype=torch.float64).T
    turned = turned_lenses(table, [(y * pitch, x * pitch) for y, x in field], defocus, wavelength)
    shifts = torch.tensor([own.shift for own in turned], dtype=torch.float64)[..., None]
    down, right = y - shifts[:, 0], x - shifts[:, 1]  # where the light is that passes the same mask pixels
    beyond = torch.hypot(down, right).clamp(min=1)  # which the stop cuts
    polynomials = zernike_polynomials(
        (turned[0].degree + 1) * (turned[0].degree + 2) // 2, down / beyond, right / beyond
    ).movedim(0, 1)  # (places, J, points)
    phase, cosines = wavefronts(turned, polynomials)
    along, across = (2 * math.pi * pitch * reach / wavelength * cosines)[:, :, None].unbind(1)
    seen = torch.cat([phase, phase + along, phase + across], 1)  # (places, depths and pixels, points)
    first, second = torch.triu_indices(len(at), len(at), 1)
    return (seen[..., first] - seen[..., second]).flatten(1)
