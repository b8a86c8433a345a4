"""Writing of raw captures as DNG files: lossless counts with levels, filter array, colours and camera data."""

from __future__ import annotations

import os
from datetime import datetime

import numpy as np
from torch import Tensor

from kornia_tidy.checks import check_choice, check_finite, check_positive
from kornia_tidy.data.metadata import exif_fields
from kornia_tidy.files import write_bytes
from kornia_tidy.lab.raw.capture import RawCapture, RawInfo
from kornia_tidy.lab.raw.color import srgb_from_xyz
from kornia_tidy.lab.raw.dng_fields import ASCII, D65, RATIONAL, SHORT, SRATIONAL, Field, dng_bytes

ORIENTATIONS = {0: 1, 1: 2, 3: 3, 2: 4, 4: 5, 6: 6, 7: 7, 5: 8}  # LibRaw's flip to TIFF's


def write_dng(path: str | os.PathLike[str], raw: RawCapture) -> None:
    """Write a capture as a DNG file, atomically.

    Args:
        path: the file, usually ``.dng``.
        raw: the capture; its counts, 0 to 65535, are stored without loss.

    Raises:
        FileNotFoundError: if the folder does not exist.
        ValueError: if the capture is empty, a count is not a whole number of 16 bits, or levels, colours or orientation
            are not those of a sensor.
    """
    write_bytes(path, encode_dng(raw))


def encode_dng(raw: RawCapture) -> bytes:
    """Encode a capture as the bytes of a DNG file, see :func:`write_dng`.

    Convention:
        - Counts take 16 bits for every converter; ``white`` is the saturation count.
        - A matrix known only from balanced colours to sRGB is converted to one from XYZ, as DNG readers expect.

    Source: Adobe, Digital Negative Specification 1.4; Exif 2.3.

    Example:
        >>> import torch
        >>> raw = RawCapture.from_counts(torch.tensor([[[64, 164], [264, 1064]]]), "GBRG", black=64, white=1064)
        >>> encode_dng(raw)[-8:] == bytes([64, 0, 164, 0, 8, 1, 40, 4])
        True
    """
    counts = raw.counts.cpu()
    if counts.numel() == 0:
        raise ValueError(f"a DNG file needs one pixel or more, got counts of shape {tuple(counts.shape)}")
    if counts.is_floating_point():
        raise ValueError(f"counts must be whole numbers, got {counts.dtype} (of a floating-point DNG)")
    if int(counts.min()) < 0 or int(counts.max()) > 65535:
        raise ValueError(f"counts must lie in 0 to 65535, found {int(counts.min())} to {int(counts.max())}")
    _check_description(raw)
    samples = counts.permute(1, 2, 0).numpy().astype(np.uint16)
    fields: list[Field] = [
        (274, SHORT, [ORIENTATIONS[raw.flip]]),
        (305, ASCII, b"kornia_tidy"),
        (50713, SHORT, raw.tile),
        (50714, RATIONAL, [float(level) for level in raw.black.flatten()]),
        (50718, RATIONAL, [raw.pixel_aspect, 1]),
        *_colors(raw),
        *_camera(raw.info),
    ]
    colors = "".join(dict.fromkeys(raw.colors))
    return dng_bytes(samples, raw.pattern_letters, colors, round(raw.white), fields, exif_fields(vars(raw.info))[1])


def _check_description(raw: RawCapture) -> None:
    """Raise ``ValueError`` unless the levels, colours and orientation of a capture can stand in a DNG."""
    check_choice("flip", raw.flip, tuple(ORIENTATIONS))
    if not 0.5 < raw.white < 65535.5:
        raise ValueError(f"white must be a count from 1 to 65535, got {raw.white}")
    check_positive("pixel_aspect", raw.pixel_aspect)
    for name in ("black", "white_balance", "daylight_balance", "xyz_to_camera", "camera_to_srgb"):
        if (values := getattr(raw, name)) is not None:
            check_finite(name, values)
            if name == "black" and bool((values < 0).any()):
                raise ValueError(f"black must be counts of zero or more, got {float(values.min())}")
            if name.endswith("balance") and bool((values <= 0).any()):
                raise ValueError(f"{name} must be positive factors, got {float(values.min())}")


# ---------------------------------------------------------------------- fields


def _colors(raw: RawCapture) -> list[Field]:
    """Return the fields of white balance and XYZ matrix, in the order of CFAPlaneColor."""
    if not raw.colors:
        return []
    planes = [raw.colors.index(letter) for letter in dict.fromkeys(raw.colors)]
    fields: list[Field] = []
    balance = raw.daylight_balance if raw.white_balance is None else raw.white_balance
    if balance is not None:
        fields.append((50728, RATIONAL, [1 / float(balance[k]) for k in planes]))
    matrix = _xyz_to_camera(raw, planes)
    if matrix is not None:
        fields += [(50721, SRATIONAL, matrix.flatten().tolist()), (50778, SHORT, [D65])]
    return fields


def _xyz_to_camera(raw: RawCapture, planes: list[int]) -> Tensor | None:
    if raw.xyz_to_camera is not None:
        return raw.xyz_to_camera
    if raw.camera_to_srgb is None:
        return None
    balanced = raw.camera_to_srgb.double().pinverse() @ srgb_from_xyz()
    daylight = raw.white_balance if raw.daylight_balance is None else raw.daylight_balance
    return balanced if daylight is None else balanced / daylight.double()[planes][: len(balanced), None]


def _camera(info: RawInfo) -> list[Field]:
    fields: list[Field] = [(50708, ASCII, _text(info.camera or "kornia_tidy"))]
    fields += [(tag, ASCII, _text(text)) for tag, text in ((271, info.make), (272, info.model)) if text]
    return fields + ([(306, ASCII, _time(info.timestamp))] if info.timestamp else [])


def _text(text: str) -> bytes:
    return text.encode("ascii", "replace")


def _time(moment: datetime) -> bytes:
    return moment.strftime("%Y:%m:%d %H:%M:%S").encode()
