"""Pictures of a point of light at several distances, read one position after another."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from kornia_tidy.lab.calibration.psf.point_images import PointImage, Tile, point_images
from kornia_tidy.lab.raw.capture import RawCapture
from kornia_tidy.sensor.sensor import SensorNoise

Picture = tuple[Tensor, Tile | None]
"""Linear light (C, H, W) or, of a mosaic, the planes of its tile and their channels."""


def planes_of_tile(raw: RawCapture, name: str) -> Picture:
    """Return the planes of a raw capture's filter array, with their channels.

    Args:
        raw: the capture.
        name: of its file, for the message.

    Raises:
        ValueError: if the tile has other sides than 2.

    Example:
        >>> planes, tile = planes_of_tile(RawCapture.from_counts(torch.ones(1, 4, 6), "RGGB", 0, 2), "a.dng")
        >>> planes.shape, tile
        (torch.Size([4, 2, 3]), ((0, 1), (1, 2)))
    """
    rows, columns = raw.tile
    if (rows, columns) not in {(1, 1), (2, 2)}:
        raise ValueError(f"cannot measure PSFs on {name}: its tile is {rows}x{columns}, 2x2 or none is needed")
    if raw.pattern is None:
        return raw.planes(), None
    letters = "".join(dict.fromkeys(raw.colors))  # both greens are one channel
    return raw.planes(), tuple(tuple(letters.index(raw.colors[color]) for color in row) for row in raw.pattern)


def images_of_files(
    read: Callable[[str], Picture],
    files: Sequence[str],
    distances: Sequence[float],
    exposures: Sequence[float],
    sensor: SensorNoise,
    *,
    window: int = 41,
    points: int = 1,
    references: Sequence[str] = (),
) -> dict[float, list[PointImage]]:
    """Read pictures of points, and keep only crops around them, by distance.

    Args:
        read: a file.
        files: sorted by distance, then by position of the point, then by exposure.
        distances: metres.
        exposures: seconds at each position.
        sensor: its noise.
        window: side of the PSFs, pixels.
        points: in each picture.
        references: the same positions with a flat mask, or none.

    Raises:
        ValueError: if the exposures of a position differ in size, or a picture cannot be used.
    """
    left, flat = iter(files), iter(references)
    images: dict[float, list[PointImage]] = {}
    for distance in distances:
        images[distance] = []
        for _ in range(len(files) // (len(distances) * len(exposures))):
            frames, tiles = zip(*[read(next(left)) for _ in exposures], strict=True)
            if len({frame.shape for frame in frames}) > 1:
                raise ValueError(f"the exposures of one place differ in size: {[tuple(f.shape) for f in frames]}")
            reference = read(next(flat))[0] if references else None
            images[distance] += point_images(
                torch.stack(frames), torch.tensor(exposures), sensor, window, points, reference, tiles[0]
            )
    return images
