"""Visible counts of a DNG with one black level for each place of the filter tile, and one white level.

A file may give black levels that repeat over a larger tile or differ by row and column, and a white level for each
plane. The counts are then rescaled linearly, so that black and white become the same. The decoder process runs this
file, so it imports only the standard library and NumPy.

Source: Adobe, Digital Negative Specification 1.7, chapter 5.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from .dng_sensor import LOSSY_JPEG, Sensor, shifted

RGB = "RGB"  # the order of three colours here, and in LibRaw's table of cameras
MOST = 65535  # LibRaw's samples
ROWS_AT_ONCE = 64


def described(header: dict[str, Any], picture: np.ndarray, sensor: Sensor, raw: Any) -> np.ndarray:
    """Write the filter array, levels and colours of a DNG into a header, and return the visible counts.

    Args:
        header: with LibRaw's colours, by plane.
        picture: LibRaw's visible samples, or all of them.
        sensor: the tags' description.
        raw: LibRaw's description.

    Convention:
        The visible area is LibRaw's: the active area, without its first row or column where its corner is odd.

    Raises:
        ValueError: if the samples are not those that the tags describe, or not finite.
    """
    sizes = raw.sizes
    if (sizes.raw_height, sizes.raw_width) != (sensor.height, sensor.width):
        raise ValueError(
            f"its tags describe a picture of {sensor.width} x {sensor.height} pixels, and LibRaw decodes one of "
            f"{sizes.raw_width} x {sizes.raw_height}"
        )
    top, left = sizes.top_margin, sizes.left_margin
    if picture.shape[:2] == (sensor.height, sensor.width):
        picture = picture[top : top + sizes.height, left : left + sizes.width]
    counts = picture.reshape(*picture.shape[:2], -1)[..., : sensor.samples]
    if sensor.floating and (faulty := counts.size - int(np.isfinite(counts).sum())):
        raise ValueError(f"{faulty} of its floating-point samples are not finite (NaN or infinite)")
    down, right = top - sensor.area[0], left - sensor.area[1]
    tile = sensor.tile if raw.num_colors > 1 else None
    letters = None if tile is None else shifted(tile, down, right)
    black, white, counts = _one_black_and_white(counts, sensor, len(letters or "1"), down, right)
    planes = "" if tile is None and sensor.samples == 1 else sensor.planes
    order = [planes.index(color) for color in RGB] if set(planes) == set(RGB) else list(range(len(planes)))
    if planes not in {"", raw.color_desc.decode("ascii", "replace")} and set(planes) != set(RGB):
        header["xyz_to_camera"] = [[0.0] * 3] * 4  # LibRaw's table has no such filters
    if sensor.samples > 1:
        _take_neutral(header, sensor)
        counts, black = counts[..., order], black[order]
    by_plane = [*order, *range(len(order), 4)]
    header["camera_to_srgb"] = [[row[c] for c in by_plane] for row in header["camera_to_srgb"]]
    for name in ("white_balance", "daylight_balance"):
        header[name] = [header[name][c] for c in by_plane]
    planes = "".join(planes[c] for c in order)
    header |= {"letters": letters, "colors": planes, "black": black.tolist(), "white": white}
    return counts if sensor.samples > 1 else counts[..., 0]


def _take_neutral(header: dict[str, Any], sensor: Sensor) -> None:
    """Take the white balance of a linear picture from its tag; LibRaw divides it by the range of each plane."""
    known = header["white_balance"][: sensor.samples]
    if len(sensor.neutral) == sensor.samples and all(value > 0 for value in known):
        told = [float(np.float32(1) / np.float32(value)) for value in sensor.neutral]
        daylight = header["daylight_balance"]
        daylight[: sensor.samples] = [d * t / k for d, t, k in zip(daylight, told, known, strict=False)]
        header["white_balance"][: sensor.samples] = told


def _one_black_and_white(
    counts: np.ndarray, sensor: Sensor, side: int, down: int, right: int
) -> tuple[np.ndarray, float, np.ndarray]:
    """Return black by places of a square tile, or by samples without one, white, and the counts for these levels.

    The levels at a place of the tile become the lowest of them, and white the highest, so that rounding is at most
    half a count of the file.
    """
    height, width, samples = counts.shape
    whites = np.array((MOST,) * samples if sensor.compression == LOSSY_JPEG else sensor.white, float)
    if not sensor.floating:
        whites = whites.clip(max=MOST)
    levels = np.roll(np.array(sensor.black, float), (-down, -right), (0, 1))
    rows, columns = (
        np.array(values[start : start + length] or [0.0] * length, float)
        for values, start, length in ((sensor.black_rows, down, height), (sensor.black_columns, right, width))
    )
    if (len(rows), len(columns)) != (height, width) or min(down, right) < 0 < max(np.ptp(rows), np.ptp(columns)):
        raise ValueError("its BlackLevelDeltaH and BlackLevelDeltaV do not cover its visible area")
    levels += rows.min() + columns.min()
    rows, columns = rows - rows.min(), columns - columns.min()
    tall, wide = (math.lcm(side, length) for length in levels.shape[:2])
    levels = np.tile(levels, (tall // levels.shape[0], wide // levels.shape[1], 1))
    places = levels.reshape(tall // side, side, wide // side, side, samples)
    black, white = places.min((0, 2)), float(whites.max())
    by_place = black if side > 1 else black[0, 0]
    by_place = by_place[..., 0] if side > 1 else by_place
    if not (np.ptp(places, (0, 2)).any() or rows.any() or columns.any() or np.ptp(whites)):
        return by_place, white, counts
    highest = levels.max((0, 1)) + rows.max() + columns.max()
    if not (whites > highest + (0 if sensor.floating else 1)).all():
        raise ValueError(f"its white levels {whites.tolist()} are not all above its black levels {highest.tolist()}")
    result = np.empty(counts.shape, np.float32 if sensor.floating else np.int32)
    x = np.arange(width)
    for top in range(0, height, ROWS_AT_ONCE):
        y = np.arange(top, min(top + ROWS_AT_ONCE, height))
        lowest = black[y % side][:, x % side]
        there = levels[y % tall][:, x % wide] + rows[y][:, None, None] + columns[:, None]
        values = lowest + (counts[y] - there) * (white - lowest) / (whites - there)
        result[y] = values if sensor.floating else np.rint(values).clip(-(2**31), 2**31 - 1)
    return by_place, white, result
