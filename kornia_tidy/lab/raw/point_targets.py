"""Points of light on a sensor: targets of a calibration of PSFs, simulated between the pixels."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

from kornia_tidy.checks import check_positive

FINE = 5  # subdivisions of a pixel along each side, on which points lie; odd, so that a pixel has a central one
SMALLEST_CELL = 32  # pixels


@torch.no_grad()
def points_of_light(
    optics: Any,
    distance: float,
    count: int,
    size: tuple[int, int],
    channels: int = 3,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Return the light of equal points at one distance on the sensor, as a sheet with pinholes gives.

    The points lie on a grid, each displaced at random by up to one pixel along either axis, in fifths of a pixel. A
    point's light reaches as far as its cell of the grid.

    Args:
        optics: a :class:`~kornia_tidy.TiDyOptics` with computed PSFs and a lens in metres.
        distance: in metres.
        count: number of points.
        size: rows and columns of the sensor.
        channels: of the light, those of the camera's spectrum or 1.
        generator: of the displacements. Default: the global generator.

    Returns:
        (channels, rows, columns), linear; the brightest value is 1.

    Raises:
        ValueError: if the PSFs were measured, which are known on whole pixels only, or the sensor is too small.

    Example:
        >>> from kornia_tidy import PixelwiseMask, TiDyOptics
        >>> light = points_of_light(TiDyOptics(PixelwiseMask(1, initial="flat")), 0.6, 2, (48, 96))
        >>> light.shape, float(light.max())
        (torch.Size([3, 48, 96]), 1.0)
    """
    check_positive("count", count, "points")
    check_positive("distance", distance, "metres")
    if optics.psf_model.measured is not None:
        raise ValueError("points of light lie between pixels, and PSFs that were measured are known on whole ones")
    rows, columns = size
    across = max(1, min(count, round(math.sqrt(count * columns / rows))))
    down = -(-count // across)
    cell = min(rows // down, columns // across)
    if cell < SMALLEST_CELL:
        raise ValueError(
            f"{count} points need a sensor of {across * SMALLEST_CELL} x {down * SMALLEST_CELL} pixels or more, got "
            f"{columns} x {rows}"
        )
    side = cell - 3 + cell % 2  # odd, and within the cell when displaced by a pixel
    fine = optics.with_fidelity(optics.fidelity.replace(window=FINE * side, stray_light="discard"))
    fine.camera = optics.camera.resized(FINE)
    psi = float(optics.camera.defocus(torch.tensor(distance, dtype=torch.float64)))
    psf = pad(fine.psf_bank(channels, defocus=[psi]).psfs[0].float(), [FINE] * 4)  # a pixel to move in
    light = psf.new_zeros(channels, rows, columns)
    for number in range(count):
        shift = torch.randint(-FINE, FINE + 1, (2,), generator=generator).tolist()
        seen = avg_pool2d(psf.roll(shift, (-2, -1)), FINE) * FINE**2
        top, left = (index * cell + (cell - side) // 2 - 1 for index in divmod(number, across))
        light[:, top : top + side + 2, left : left + side + 2] += seen
    return light / light.max()
