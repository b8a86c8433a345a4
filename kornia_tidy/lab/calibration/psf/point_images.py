"""Point images: crops of a capture around each point source, with background subtracted and noise variance."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from kornia_tidy.checks import check_float_tensor, check_positive
from kornia_tidy.lab.calibration.psf.exposures import SATURATION, capture_variance, merge_exposures
from kornia_tidy.lab.calibration.psf.points import (
    annulus_background,
    centre_of_light,
    centre_of_symmetry,
    cut_out,
    find_points,
    light_around,
)
from kornia_tidy.sensor.sensor import SensorNoise

MARGIN = 8  # pixels around the window, where a sub-pixel shift of an image may ring
NOTHING = torch.zeros(1, dtype=torch.float64)
LEAST_SIGNAL = 10.0  # ratio of a point's light to its noise
Tile = tuple[tuple[int, ...], ...]  # channel of each pixel in a filter array's square tile, by rows


@dataclass(frozen=True, eq=False)
class PointImage:
    """Image of one point source.

    Args:
        place: estimated row and column of the chief ray, in pixels of the frame.
        light: (C, M, M) centred on the pixel nearest to the chief ray, background subtracted, per unit of exposure.
        variance: (C, M, M) noise variance of ``light``.
        tile: tile of the filter array if the C planes are those of a mosaic, or None.
        fault: reason for which the image cannot be used, or None.
        around: (C,) mean light of a pixel between the window and the annulus of the background.
        background_variance: (C,) variance of the background that was subtracted.
        peaks: (E, C) brightest value below saturation in the window of each frame, 1 at full scale.
        peak_shot: (E, C) standard deviation of the shot noise of these values.
        peak_noise: standard deviation of a clipped value, which has no shot noise.
    """

    place: tuple[float, float]
    light: Tensor
    variance: Tensor
    tile: Tile | None = None
    fault: str | None = None
    around: Tensor = NOTHING
    background_variance: Tensor = NOTHING
    peaks: Tensor = NOTHING
    peak_shot: Tensor = NOTHING
    peak_noise: float = 0.0

    @property
    def offset(self) -> tuple[float, float]:
        """Position of the chief ray relative to the centre of the nearest pixel, (row, column)."""
        return self.place[0] - round(self.place[0]), self.place[1] - round(self.place[1])

    @property
    def phases(self) -> Tensor:
        """Offset of each plane's pixels from those of the first plane, down and right, (C, 2), in pixels of a plane."""
        return _phases(self.tile, len(self.light))

    @property
    def channels(self) -> list[int]:
        """Channel of each plane."""
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
    """Cut out the images of the points in one capture, which has one or several exposures of a static scene.

    Args:
        frames: (E, C, H, W) linear, black level subtracted, 1 at full scale. For a mosaic these are the planes that
            :meth:`RawCapture.planes` returns.
        exposures: (E,) in seconds or any other unit.
        sensor: noise of one frame.
        window: side P of the PSF to be measured, in pixels of the sensor, odd. The background is measured at distances
            from P to 1.5 P pixels.
        points: number of points.
        reference: (C, H, W) capture of the same points with a flat modulator, without saturation. A point's position
            is then the centre of this light, which is symmetric. Without it, it is the centre of the coded light.
        tile: for a mosaic, the channel of each pixel in its tile: ``((0, 1), (1, 2))`` for RGGB. Planes of one
            channel together give one PSF, on the pixels of the sensor.
        saturation: values at or above this are ignored.

    Returns:
        One image for each point. It has a fault if it is cropped by the frame, saturated in every exposure, or faint.

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
    """Convert the side of a window from pixels of the sensor to pixels of a mosaic's plane, rounded up to odd.

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
        background, background_variance = annulus_background(light, near, window, 1.5 * window)
        light = light - background
        clear, centre = light, centre_of_light
        if reference is not None:
            clear, centre = reference[..., rows, columns].double(), centre_of_symmetry
            clear = clear - annulus_background(clear, near, window, 1.5 * window)[0]
        places = torch.tensor([centre(channel[None], near, window) for channel in clear], dtype=torch.float64)
        places = places + _phases(tile, len(places))
        weight = cut_out(clear, near, window).sum((1, 2)).clamp(min=0)
        row, column = (weight @ places / weight.sum()).tolist()
        nearest = round(row), round(column)
        around = light_around(light, nearest, window)
        inside = cut_out(frames[..., rows, columns], nearest, window)
        light, variance = (cut_out(x, nearest, side) for x in (light, variance))
    except ValueError as error:
        empty = torch.zeros(frames.shape[1], side, side, dtype=torch.float64)
        return PointImage((float(start[0]), float(start[1])), empty, empty, tile, str(error))
    saturated = ~variance.isfinite()
    fault = None
    if bool(saturated.any()):
        fault = f"{int(saturated.any(0).sum())} pixels are saturated in every exposure"
    else:
        signal = float((light.sum((1, 2)) / variance.sum((1, 2)).sqrt()).min())
        if signal < LEAST_SIGNAL:
            fault = f"its light is {signal:.1f} times its noise, {LEAST_SIGNAL:g} are needed"
    place = row + corner[0], column + corner[1]
    peaks = torch.where(inside < saturation, inside, 0).amax((-2, -1))
    clipped = capture_variance(torch.zeros_like(peaks), sensor)
    shot = (capture_variance(peaks, sensor) - clipped).clamp(min=0).sqrt()
    return PointImage(
        place, light, variance, tile, fault, around, background_variance, peaks, shot, float(clipped.max().sqrt())
    )
