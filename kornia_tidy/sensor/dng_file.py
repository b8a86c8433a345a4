"""Raw captures as DNG files: counts uncompressed, exactly as they are, with what it takes to read them as light."""

from __future__ import annotations

import os
import struct
from collections.abc import Sequence
from datetime import datetime
from fractions import Fraction

import numpy as np
import torch
from torch import Tensor

from kornia_tidy.files import write_bytes
from kornia_tidy.sensor.raw_file import RawCapture, RawInfo

Field = tuple[int, int, Sequence[float] | bytes]  # tag, type, values

BYTE, ASCII, SHORT, LONG, RATIONAL, SRATIONAL = 1, 2, 3, 4, 5, 10  # types of TIFF 6.0
CODES = {BYTE: "B", SHORT: "H", LONG: "I"}
COLOR_CODES = "RGBCMYW"  # a letter's place is its code in CFAPattern and CFAPlaneColor
ORIENTATIONS = {0: 1, 1: 2, 3: 3, 2: 4, 4: 5, 6: 6, 7: 7, 5: 8}  # LibRaw's flip to TIFF's
FILTER_ARRAY, LINEAR_RAW = 32803, 34892  # photometric interpretations
D65 = 21  # EXIF's light source
LINEAR_SRGB_FROM_XYZ = (
    (3.2404542, -1.5371385, -0.4985314),
    (-0.9692660, 1.8760108, 0.0415560),
    (0.0556434, -0.2040259, 1.0572252),
)


def write_dng(path: str | os.PathLike[str], raw: RawCapture) -> None:
    """Write a capture as a DNG file, all or nothing.

    Args:
        path: where to, as a rule ``.dng``.
        raw: the capture; its counts, 0 to 65535, come back equal to the last bit.

    Raises:
        FileNotFoundError: if the folder does not exist.
        ValueError: if the capture is empty, or a count does not fit 16 bits.
    """
    write_bytes(path, encode_dng(raw))


def encode_dng(raw: RawCapture) -> bytes:
    """Return a capture as the bytes of a DNG file, see :func:`write_dng`.

    Convention:
        - Counts take 16 bits whatever the converter had; ``white`` says how far they go.
        - A matrix that is known only from balanced colours to sRGB is written as one from XYZ, for LibRaw and others.

    Source: Adobe, Digital Negative Specification 1.4; TIFF 6.0; Exif 2.3.

    Example:
        >>> raw = RawCapture.from_counts(torch.tensor([[[64, 164], [264, 1064]]]), "GBRG", black=64, white=1064)
        >>> encode_dng(raw)[-8:] == bytes([64, 0, 164, 0, 8, 1, 40, 4])
        True
    """
    counts = raw.counts.cpu()
    if counts.numel() == 0:
        raise ValueError(f"a DNG file needs one pixel or more, got counts of shape {tuple(counts.shape)}")
    if int(counts.min()) < 0 or int(counts.max()) > 65535:
        raise ValueError(f"counts must lie in 0 to 65535, found {int(counts.min())} to {int(counts.max())}")
    samples = np.ascontiguousarray(counts.permute(1, 2, 0).numpy().astype("<u2"))
    height, width, channels = samples.shape
    fields: list[Field] = [
        (254, LONG, [0]),  # the full picture
        (256, LONG, [width]),
        (257, LONG, [height]),
        (258, SHORT, [16] * channels),
        (259, SHORT, [1]),  # not compressed
        (262, SHORT, [LINEAR_RAW if raw.pattern is None else FILTER_ARRAY]),
        (274, SHORT, [ORIENTATIONS[raw.flip]]),
        (277, SHORT, [channels]),
        (278, LONG, [height]),  # one strip
        (279, LONG, [samples.nbytes]),
        (284, SHORT, [1]),  # channels of a pixel together
        (305, ASCII, b"kornia_tidy"),
        (50706, BYTE, [1, 4, 0, 0]),  # DNG version, and that which a reader needs
        (50707, BYTE, [1, 1, 0, 0]),
        (50717, LONG, [round(raw.white)] * channels),
        (50718, RATIONAL, [raw.pixel_aspect, 1]),
        *_filter_array(raw),
        *_colors(raw),
        *_camera(raw.info),
    ]
    return _tiff(fields, _exposure(raw.info), samples.tobytes())


# ---------------------------------------------------------------------- fields


def _filter_array(raw: RawCapture) -> list[Field]:
    black = [float(level) for level in raw.black.flatten()]
    if raw.pattern is None:
        return [(50713, SHORT, [1, 1]), (50714, RATIONAL, black)]
    places = [raw.colors[index] for row in raw.pattern for index in row]
    return [
        (33421, SHORT, raw.tile),
        (33422, BYTE, [COLOR_CODES.index(letter) for letter in places]),
        (50710, BYTE, [COLOR_CODES.index(letter) for letter in dict.fromkeys(raw.colors)]),
        (50711, SHORT, [1]),  # pixels in rows and columns
        (50713, SHORT, raw.tile),
        (50714, RATIONAL, black),
    ]


def _colors(raw: RawCapture) -> list[Field]:
    """Matrix from XYZ and white balance, by the planes of CFAPlaneColor."""
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
    balanced = raw.camera_to_srgb.double().pinverse() @ torch.tensor(LINEAR_SRGB_FROM_XYZ, dtype=torch.float64)
    daylight = raw.white_balance if raw.daylight_balance is None else raw.daylight_balance
    return balanced if daylight is None else balanced / daylight.double()[planes][: len(balanced), None]


def _camera(info: RawInfo) -> list[Field]:
    fields: list[Field] = [(50708, ASCII, _text(info.camera or "kornia_tidy"))]
    fields += [(tag, ASCII, _text(text)) for tag, text in ((271, info.make), (272, info.model)) if text]
    return fields + ([(306, ASCII, _time(info.timestamp))] if info.timestamp else [])


def _exposure(info: RawInfo) -> list[Field]:
    """Fields of the Exif directory."""
    numbers = ((33434, info.exposure), (33437, info.aperture))
    fields: list[Field] = [(tag, RATIONAL, [value]) for tag, value in numbers if value]
    if info.focal_length:
        fields.append((37386, RATIONAL, [1e3 * info.focal_length]))  # millimetres
    if info.iso:
        fields.append((34855, SHORT, [min(round(info.iso), 65535)]))
    fields += [(42036, ASCII, _text(info.lens))] if info.lens else []
    return fields + ([(36867, ASCII, _time(info.timestamp))] if info.timestamp else [])


def _text(text: str) -> bytes:
    return text.encode("ascii", "replace")


def _time(moment: datetime) -> bytes:
    return moment.strftime("%Y:%m:%d %H:%M:%S").encode()


# ---------------------------------------------------------------------- TIFF


def _tiff(fields: list[Field], exif: list[Field], data: bytes) -> bytes:
    """A little-endian TIFF: header, directory, Exif directory, and the data of its one strip."""
    begin = 8
    if exif:
        fields = [*fields, (34665, LONG, [0])]
    fields = [*fields, (273, LONG, [0])]
    table = _directory(fields, begin)  # once for its size
    nested = _directory(exif, begin + len(table)) if exif else b""
    strip = -(-(begin + len(table) + len(nested)) // 16) * 16
    places = {34665: begin + len(table), 273: strip}
    fields = [(tag, kind, [places[tag]] if tag in places else values) for tag, kind, values in fields]
    head = struct.pack("<2sHI", b"II", 42, begin) + _directory(fields, begin) + nested
    return head.ljust(strip, b"\0") + data


def _directory(fields: list[Field], begin: int) -> bytes:
    """A directory that starts at a place in the file, and behind it the values longer than four bytes."""
    entries, longer = b"", b""
    outside = begin + 2 + 12 * len(fields) + 4
    for tag, kind, values in sorted(fields, key=lambda field: field[0]):
        count, content = _packed(kind, values)
        if len(content) > 4:
            place = struct.pack("<I", outside + len(longer))
            longer += content + b"\0" * (len(content) % 2)
            content = place
        entries += struct.pack("<HHI", tag, kind, count) + content.ljust(4, b"\0")
    return struct.pack("<H", len(fields)) + entries + struct.pack("<I", 0) + longer


def _packed(kind: int, values: Sequence[float] | bytes) -> tuple[int, bytes]:
    """How many values there are, and their bytes."""
    if isinstance(values, bytes):
        return len(values) + 1, values + b"\0"
    if kind in CODES:
        return len(values), struct.pack(f"<{len(values)}{CODES[kind]}", *(int(value) for value in values))
    parts = [Fraction(value).limit_denominator(1_000_000) for value in values]
    code = "I" if kind == RATIONAL else "i"
    return len(parts), b"".join(struct.pack(f"<2{code}", part.numerator, part.denominator) for part in parts)
