"""The image of one point of light, cut out of a capture and ready to be measured."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from kornia_tidy.calibration.psf.exposures import SATURATION, merge_exposures
from kornia_tidy.calibration.psf.points import (
    annulus_background,
    centre_of_light,
    centre_of_symmetry,
    cut_out,
    find_points,
)
from kornia_tidy.checks import check_float_tensor, check_positive
from kornia_tidy.sensor.noise import SensorNoise

MARGIN = 8  # pixels around the window, in which moving an image by parts of a pixel may ring
LEAST_SIGNAL = 10.0  # of a point's light over its noise
Tile = tuple[tuple[int, ...], ...]  # which channel each pixel of a filter array's square tile sees, by rows


@dataclass(frozen=True, eq=False)
class PointImage:
    """One point of light on the sensor.

    Args:
        place: row and column in the frame, in its pixels, where the chief ray falls as far as is known.
        light: (C, M, M) about the nearest pixel, the background taken off, per unit of exposure.
        variance: (C, M, M).
        tile: of the filter array whose planes these channels are, or None.
        fault: why it is of no use, or None.
    """

    place: tuple[float, float]
    light: Tensor
    variance: Tensor
    tile: Tile | None = None
    fault: str | None = None

    @property
    def offset(self) -> tuple[float, float]:
        """Where the chief ray falls, from the centre of the nearest pixel."""
        return self.place[0] - round(self.place[0]), self.place[1] - round(self.place[1])

    @property
    def phases(self) -> Tensor:
        """How far down and right of the first plane's pixels those of each plane lie, (C, 2), in pixels of a plane."""
        return _phases(self.tile, len(self.light))

    @property
    def channels(self) -> list[int]:
        """Which channel each plane sees."""
        return list(range(len(self.light))) if self.tile is None else [channel for row in self.tile for channel in row]


def point_images(
    frames: Tensor,
    exposures: Tensor,
    sensor: SensorNoise,
    window: int,
    points: int = 1,
    reference: Tensor | None = None,
    tile: Tile | None = None,
    saturation: float = SATURATION,
) -> list[PointImage]:
    """Return the images of the points in one capture, a frame or several exposures that nothing moved between.

    Args:
        frames: (E, C, H, W) linear, the black level taken off and 1 at full scale. Of a mosaic the planes, as
            :meth:`RawCapture.planes` gives them.
        exposures: (E,) in seconds or any other unit.
        sensor: noise of one frame.
        window: side P of the PSF to be measured in pixels of the sensor, odd. The background is that between P and
            1.5 P pixels of the point.
        points: how many points there are.
        reference: (C, H, W) of the same points at the same places, nowhere saturated, the modulator flat: then each
            point's place is the centre of that light, which is symmetric. Else it is the centre of the coded light.
        tile: of a mosaic, the channel that each pixel of its tile sees: ``((0, 1), (1, 2))`` for RGGB. Planes of one
            channel then make one PSF together, on the pixels of the sensor.
        saturation: values at or above are left out.

    Returns:
        One image a point. Those cut short, saturated in the shortest exposure too, or too faint, have a fault.

    Raises:
        TypeError: if the frames are not floating point.
        ValueError: if shapes do not fit each other, the window is even or larger than the picture.

    Example:
        >>> x = torch.arange(64.0)
        >>> spot = 0.8 * torch.exp(-((x[:, None] - 30.2) ** 2 + (x - 33) ** 2) / 8)
        >>> (point,) = point_images(spot[None, None], torch.ones(1), SensorNoise.physical(10500, 2.4), 15)
        >>> [round(c, 2) for c in point.place], point.light.shape, point.fault
        ([30.2, 33.0], torch.Size([1, 31, 31]), None)
    """
    check_float_tensor("frames", frames, 4, "(E, C, H, W)")
    check_positive("window", window)
    if window % 2 == 0:
        raise ValueError(f"window must be odd, so that it has a centre, got {window}")
    if reference is not None and reference.shape != frames.shape[1:]:
        raise ValueError(
            f"reference must have the frames' shape {tuple(frames.shape[1:])}, got {tuple(reference.shape)}"
        )
    if tile is not None and any(len(row) != len(tile) for row in tile) | (len(tile) ** 2 != frames.shape[1]):
        raise ValueError(f"tile must be square with a place for each of {frames.shape[1]} planes, got {tile}")
    window = plane_window(window, tile)
    found = find_points(frames.clamp(max=saturation).mean((0, 1)), points, window)
    return [_point_image(frames, exposures, sensor, window, place, reference, tile, saturation) for place in found]


def plane_window(window: int, tile: Tile | None) -> int:
    """Return the odd side of the window that holds one of the sensor's pixels, in pixels of a mosaic's plane.

    Example:
        >>> plane_window(41, None), plane_window(41, ((0, 1), (1, 2))), plane_window(43, ((0, 1), (1, 2)))
        (41, 21, 23)
    """
    return window if tile is None else 2 * -(-(window // 2) // len(tile)) + 1


def _phases(tile: Tile | None, planes: int) -> Tensor:
    if tile is None:
        return torch.zeros(planes, 2, dtype=torch.float64)
    steps = torch.arange(len(tile), dtype=torch.float64) / len(tile)
    return torch.cartesian_prod(steps, steps)


def _point_image(
    frames: Tensor,
    exposures: Tensor,
    sensor: SensorNoise,
    window: int,
    start: tuple[int, int],
    reference: Tensor | None,
    tile: Tile | None,
    saturation: float,
) -> PointImage:
    side = window + 2 * MARGIN
    rows, columns = (
        slice(max(0, at - 2 * window), min(length, at + 2 * window + 1))
        for at, length in zip(start, frames.shape[-2:], strict=True)
    )
    corner = rows.start, columns.start
    near = start[0] - corner[0], start[1] - corner[1]
    light, variance = merge_exposures(frames[..., rows, columns], exposures, sensor, saturation)
    try:
        light = light - annulus_background(light, near, window, 1.5 * window)[:, None, None]
        clear, centre = light, centre_of_light
        if reference is not None:
            clear, centre = reference[..., rows, columns].double(), centre_of_symmetry
            clear = clear - annulus_background(clear, near, window, 1.5 * window)[:, None, None]
        places = torch.tensor([centre(channel[None], near, window) for channel in clear], dtype=torch.float64)
        places = places + _phases(tile, len(places))
        share = cut_out(clear, near, window).sum((1, 2)).clamp(min=0)
        row, column = (share @ places / share.sum()).tolist()
        nearest = round(row), round(column)
        light, variance = (cut_out(x, nearest, side) for x in (light, variance))
    except ValueError as error:
        empty = torch.zeros(frames.shape[1], side, side, dtype=torch.float64)
        return PointImage((float(start[0]), float(start[1])), empty, empty, tile, str(error))
    blind = ~variance.isfinite()
    fault = None
    if bool(blind.any()):
        fault = f"{int(blind.any(0).sum())} pixels are saturated in every exposure"
    else:
        signal = float((light.sum((1, 2)) / variance.sum((1, 2)).sqrt()).min())
        if signal < LEAST_SIGNAL:
            fault = f"its light is {signal:.1f} times its noise, {LEAST_SIGNAL:g} are needed"
    return PointImage((row + corner[0], column + corner[1]), light, variance, tile, fault)
