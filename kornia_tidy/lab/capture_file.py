"""Captures in files, raw ones or pictures, as the linear light that reconstructions take."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import torch
from kornia.color import rgb_to_linear_rgb
from torch import Tensor

from kornia_tidy.data.image_files import read_image, read_linear
from kornia_tidy.lab.calibration.noise.photon_transfer import PhotonTransfer
from kornia_tidy.lab.raw.capture import RawCapture
from kornia_tidy.lab.raw.develop import develop
from kornia_tidy.lab.raw.developed_noise import developed_noise
from kornia_tidy.sensor.sensor import SensorNoise

PICTURES = (
    ".png", ".tif", ".tiff", ".jpg", ".jpeg", ".npy", ".npz", ".pfm", ".pgm", ".ppm", ".pam", ".bmp", ".webp",
)  # fmt: skip
"""Suffixes of files that are pictures; others are raw files."""


class CaptureLight(NamedTuple):
    """A capture in linear light, and its description in the file."""

    light: Tensor
    """(C, H, W), as the pixels lie on the sensor."""
    upright: Callable[[Tensor], Tensor]
    """Turns a picture of the same orientation upright."""
    info: dict[str, Any]
    """Camera and exposure."""
    noise: SensorNoise | None
    """In units of the light; None if it is not known."""


def read_light(
    path: str | os.PathLike[str],
    *,
    raw: RawCapture | None = None,
    linear: bool = False,
    white_balance: str | Tensor | None = None,
    sensor: SensorNoise | None = None,
    calibration: PhotonTransfer | None = None,
) -> CaptureLight:
    """Read a capture as linear light.

    Args:
        path: of a picture or a raw file.
        raw: the capture, if it was opened otherwise.
        linear: a picture holds linear light, not sRGB.
        white_balance: of a raw file, see :func:`~kornia_tidy.lab.raw.develop.develop`.
        sensor: its noise. None: that of the noise profile of a raw file, if it has one.
        calibration: measurement of the noise, with a sensor in the units of the raw file before it is developed.

    Raises:
        FileNotFoundError: if the file is missing.
        ValueError: if it cannot be read, or was not taken as the captures of the calibration.

    Example:
        >>> import tempfile
        >>> from kornia_tidy.data.image_files import write_image
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_image(f"{folder}/a.png", torch.full((3, 4, 6), 0.5), bits=16)
        ...     read_light(f"{folder}/a.png").light.mean().round(decimals=3)
        tensor(0.2140)
    """
    if raw is None and Path(path).suffix.lower() in PICTURES:
        picture = read_linear(path) if linear else read_image(path)
        light = picture if linear else rgb_to_linear_rgb(picture.expand(3, -1, -1))[: len(picture)]
        return CaptureLight(light, _as_it_is, {}, sensor)
    raw = RawCapture.open(path) if raw is None else raw
    light = develop(raw, white_balance=white_balance, encoded=False, upright=False)
    bare = replace(raw, counts=torch.empty(0))  # keeps the orientation without the counts
    if calibration is not None:
        calibration.check_taken_alike(raw, str(path))
    known = sensor is not None and calibration is None
    noise = sensor if known else developed_noise(raw, white_balance, sensor)
    return CaptureLight(light, bare.upright, vars(raw.info), noise)


def _as_it_is(image: Tensor) -> Tensor:
    return image
