"""Raw captures: the digital counts of a sensor, with its black and white levels, filter array and colours."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from datetime import datetime
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kornia_tidy.checks import check_choice, check_positive
from kornia_tidy.lab.raw.decoding import Source, decode_raw, source_bytes, source_name
from kornia_tidy.lab.raw.filter_array import filter_tile, indexed_tile, tile_planes, tiled
from kornia_tidy.lab.raw.validation import check_counts, validated_white


@dataclass(frozen=True)
class RawInfo:
    """Camera and exposure data of a raw file; None where the file lacks the value.

    Attributes:
        make: manufacturer of the camera.
        model: model of the camera.
        lens: model of the lens.
        iso: sensitivity.
        exposure: exposure time in seconds.
        aperture: f-number.
        focal_length: in metres.
        timestamp: time of the exposure by the camera's clock.
        noise_profile: scale S and offset O of the noise's variance S x + O, x from 0 (black) to 1 (white): one pair for
            all colours, or one for each.
        ignored_opcodes: names of the steps that the file (a DNG) asks for and that are not applied, such as a phone's
            gain map against shading; ``(optional)`` follows those that a reader may leave out.
    """

    make: str | None = None
    model: str | None = None
    lens: str | None = None
    iso: float | None = None
    exposure: float | None = None
    aperture: float | None = None
    focal_length: float | None = None
    timestamp: datetime | None = None
    noise_profile: tuple[tuple[float, float], ...] | None = None
    ignored_opcodes: tuple[str, ...] = ()

    @property
    def camera(self) -> str:
        """Make and model of the camera, without the make if the model begins with it; empty if unknown.

        Example:
            >>> RawInfo("NIKON CORPORATION", "NIKON D5100").camera, RawInfo("Sony", "ILCE-7").camera
            ('NIKON D5100', 'Sony ILCE-7')
        """
        make, model = (self.make or "").strip(), (self.model or "").strip()
        first = make.split()[0].lower() if make else ""
        return model if first and first in model.lower() else f"{make} {model}".strip()


@dataclass(frozen=True, eq=False)
class RawCapture:
    """Counts of the visible area of a sensor, with levels, colours and orientation.

    Attributes:
        counts: (C, H, W) int32, or float32 from a floating-point DNG, in the sensor's orientation; C is 1 behind a
            filter array or for a monochrome sensor, 3 or 4 for linear colours.
        pattern: index into ``colors`` at each place of the repeating tile, 2x2 (Bayer, four-colour), 4x4 (quad-Bayer)
            or 6x6 (X-Trans), from the upper left corner of ``counts``; None without a filter array.
        colors: names of the channels by index, ``"RGBG"`` for a Bayer array (the second green is that of blue's
            rows), ``"RGB"`` for other arrays of these colours and linear RGB, ``""`` for monochrome; of four colours
            as the file names them: C is cyan, M magenta, Y yellow, W white.
        black: count without light, float32: one for each place of the tile, or (C,) without a filter array.
        white: saturation count, with the black level included.
        xyz_to_camera: matrix from CIE XYZ under D65 to the camera's colours, (n, 3) for the n = 3 or 4 different
            letters of ``colors``, or None if unknown.
        camera_to_srgb: matrix from white-balanced camera colours to linear sRGB, (3, 3 or 4), computed from the
            colour matrices of a DNG, or None.
        white_balance: factors as shot, (len(colors),), 1 for the first green, or the first channel without one; None if
            unknown.
        daylight_balance: factors for daylight, likewise.
        flip: how to turn the picture upright: 1 mirrors columns, 2 rows, then 4 swaps the two (LibRaw's code).
        pixel_aspect: width of a pixel over its height.
        info: camera, lens and exposure.
    """

    counts: Tensor = field(repr=False)
    pattern: tuple[tuple[int, ...], ...] | None
    colors: str
    black: Tensor
    white: float
    xyz_to_camera: Tensor | None = None
    camera_to_srgb: Tensor | None = None
    white_balance: Tensor | None = None
    daylight_balance: Tensor | None = None
    flip: int = 0
    pixel_aspect: float = 1.0
    info: RawInfo = field(default_factory=RawInfo)

    @classmethod
    def open(
        cls, source: Source, *, white: float | None = None, timeout: float = 60.0, memory_limit: int = 2**31
    ) -> RawCapture:
        """Read a camera raw file.

        LibRaw decodes the file in a separate process with limits of time and memory. A damaged file that makes LibRaw
        crash or hang therefore raises an error and does no other harm. The decoded counts are validated.

        Args:
            source: a path, the bytes of a file, or a binary file.
            white: saturation count. Default: that of the file or, if many counts lie far above it, the largest count.
            timeout: seconds that decoding may take.
            memory_limit: bytes of memory that decoding may use.

        Raises:
            FileNotFoundError: if the file is missing.
            ValueError: if it is empty, damaged, cut short, not a raw file, of a kind that LibRaw does not decode,
                without a picture, or too much for the limits.

        Warns:
            UserWarning: if the white level of the file is too low, if more than one count in a thousand lies above
                white, if the file asks for opcodes, which are not applied, or if a file without a header is recognised
                as a Kodak C330's by its length.

        Convention:
            - The counts cover the visible area without the masked borders. A tone curve of the file is inverted.
            - Floating-point samples are returned unchanged.
            - Where the black levels of a DNG repeat over a larger tile than its filter array, or differ by row or
              column, or its planes differ in white, the counts are rescaled to one black level for each place and one
              white level, and rounded.
        """
        if white is not None:
            check_positive("white", white, "counts")
        header, counts, length = decode_raw(source, timeout, memory_limit)
        name = source_name(source)
        try:
            raw = _from_header(header if white is None else {**header, "white": white}, counts)
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"cannot read {name}: its description of the sensor is invalid ({error})") from None
        check_counts(name, raw.counts, raw.black, raw.white, length)
        if raw.info.ignored_opcodes:
            warnings.warn(
                f"{name}: its opcodes {', '.join(raw.info.ignored_opcodes)} are not applied: shading, distortion and "
                "defects of the camera stay in the counts; a DNG converter can remove them",
                stacklevel=2,
            )
        return replace(raw, white=validated_white(name, raw.counts, raw.white, given=white is not None))

    @classmethod
    def open_dump(
        cls,
        source: Source,
        size: tuple[int, int],
        pattern: str | None,
        black: float | Sequence[float],
        white: float,
        dtype: str = "uint16",
        byte_order: str = "little",
    ) -> RawCapture:
        """Read a headerless dump of a sensor's counts, stored row by row.

        Args:
            source: a path, the bytes of a file, or a binary file.
            size: rows and columns.
            pattern: letters of the filter array's tile, by rows, such as ``"RGGB"``; None for a monochrome sensor.
            black: count without light, one or one for each place of the tile.
            white: saturation count.
            dtype: ``"uint8"`` or ``"uint16"``.
            byte_order: ``"little"`` or ``"big"``.

        Raises:
            FileNotFoundError: if the file is missing.
            ValueError: if the file's length is not that of these counts, or they are implausible.

        Warns:
            UserWarning: if more than one count in a thousand lies above white.

        Example:
            >>> data = bytes([1, 2, 1, 3, 1, 4, 2, 0])
            >>> RawCapture.open_dump(data, (2, 2), "RGGB", black=256, white=1023, byte_order="big").counts
            tensor([[[258, 259],
                     [260, 512]]], dtype=torch.int32)
        """
        check_choice("dtype", dtype, ("uint8", "uint16"))
        check_choice("byte_order", byte_order, ("little", "big"))
        name, data = source_name(source), source_bytes(source)
        layout = np.dtype(dtype).newbyteorder("<" if byte_order == "little" else ">")
        height, width = size
        if min(size) < 1 or len(data) != height * width * layout.itemsize:
            raise ValueError(
                f"cannot read {name}: {width} x {height} counts of {dtype} take {height * width * layout.itemsize} "
                f"bytes, it has {len(data)}"
            )
        if not white <= np.iinfo(dtype).max:
            raise ValueError(f"white must be at most {np.iinfo(dtype).max}, the largest {dtype}, got {white}")
        counts = torch.from_numpy(np.frombuffer(data, layout).astype(np.int32).reshape(1, height, width))
        raw = cls.from_counts(counts, pattern, black, white)
        check_counts(name, raw.counts, raw.black, raw.white, len(data))
        validated_white(name, raw.counts, raw.white, given=True)
        return raw

    @classmethod
    def from_counts(
        cls,
        counts: Tensor,
        pattern: str | None,
        black: float | Sequence[float],
        white: float,
        info: RawInfo | None = None,
    ) -> RawCapture:
        """Return a raw capture made from a tensor of counts.

        Args:
            counts: (C, H, W), whole numbers; C is 1, or 3 for linear RGB.
            pattern: letters of the repeating tile by rows, such as ``"RGGB"``, or 36 for X-Trans; None without a
                filter array.
            black: count without light, one or as many as places in the tile (by rows), or channels.
            white: saturation count.
            info: camera and exposure, if known.

        Raises:
            ValueError: if the shape of the counts, the pattern and the levels contradict each other.

        Example:
            >>> raw = RawCapture.from_counts(torch.tensor([[[64, 164], [264, 1064]]]), "GBRG", black=64, white=1064)
            >>> raw.pattern, raw.colors
            (((3, 2), (0, 1)), 'RGBG')
            >>> raw.mosaic()
            tensor([[[0.0000, 0.1000],
                     [0.2000, 1.0000]]])
        """
        if counts.ndim != 3 or counts.shape[0] not in {1, 3}:
            raise ValueError(f"counts must have shape (1 or 3, H, W), got {tuple(counts.shape)}")
        if pattern is not None and counts.shape[0] != 1:
            raise ValueError(f"counts behind a filter array must have one channel, got {counts.shape[0]}")
        if pattern is None:
            tile, colors = None, "" if counts.shape[0] == 1 else "RGB"
            shape = (counts.shape[0],)
        else:
            tile, colors = filter_tile(pattern)
            shape = (len(tile), len(tile))
        levels = torch.as_tensor(black, dtype=torch.float32)
        if levels.numel() not in {1, math.prod(shape)}:
            raise ValueError(f"black must be one level or {math.prod(shape)}, got {levels.numel()}")
        if not white > float(levels.max()):
            raise ValueError(f"white must be above black, got white {white} and black {float(levels.max())}")
        levels = levels.flatten().expand(math.prod(shape)).reshape(shape)
        return cls(counts.to(torch.int32), tile, colors, levels, float(white), info=info or RawInfo())

    @property
    def tile(self) -> tuple[int, int]:
        """Period of the filter array in rows and columns; (1, 1) without one."""
        return (1, 1) if self.pattern is None else (len(self.pattern), len(self.pattern[0]))

    @property
    def pattern_letters(self) -> str | None:
        """Colours of the filter array's tile, by rows, such as ``"RGGB"``; None without one."""
        return None if self.pattern is None else "".join(self.colors[index] for row in self.pattern for index in row)

    def mosaic(self) -> Tensor:
        r"""Return linear light, :math:`(n - n_{black}) / (n_{white} - n_{black})`, (C, H, W) float32.

        Convention:
            Values are not clamped: noise around black stays negative, and counts above white stay above 1.
        """
        light = self.counts.float()
        if self.pattern is None:
            black = self.black[:, None, None]
            return light.sub_(black).div_(self.white - black)
        rows = self.tile[0]
        for row, black in enumerate(tiled(self.black, rows, light.shape[-1])):  # whole rows are contiguous in memory
            light[:, row::rows].sub_(black).div_(self.white - black)
        return light

    def planes(self) -> Tensor:
        """Return one plane of samples for each place of the filter tile, (places, H // rows, W // columns).

        Nothing is interpolated. Without a filter array the planes are :meth:`mosaic`. Incomplete tiles at the right
        and the bottom are left out.
        """
        return tile_planes(self.mosaic(), self.tile)

    def upright(self, image: Tensor) -> Tensor:
        """Return a picture of this capture, (..., H, W), rotated and mirrored upright."""
        if self.flip & 2:
            image = image.flip(-2)
        if self.flip & 1:
            image = image.flip(-1)
        return image.transpose(-1, -2) if self.flip & 4 else image


def _from_header(header: dict[str, Any], counts: Tensor) -> RawCapture:
    """Return the capture described by the decoder's header, with checks against values of damaged files."""
    pattern, colors, info = header.get("pattern"), header["colors"], dict(header["info"])
    if header.get("letters"):
        pattern, colors = indexed_tile(header["letters"], colors)
    if pattern is not None:
        pattern = tuple(map(tuple, pattern))
        if not all(0 <= index < len(colors) for row in pattern for index in row):
            raise ValueError(f"filter array {pattern} of colours {colors!r}")
        if counts.shape[1] < len(pattern) or counts.shape[2] < len(pattern[0]):
            raise ValueError(f"{counts.shape[2]} x {counts.shape[1]} pixels")
    if not 0.1 < header["pixel_aspect"] < 10:
        raise ValueError(f"pixel aspect {header['pixel_aspect']}")
    info["ignored_opcodes"] = tuple(info.get("ignored_opcodes", ()))
    if "timestamp" in info:
        info["timestamp"] = datetime.fromisoformat(info["timestamp"])
    if "noise_profile" in info:
        info["noise_profile"] = tuple((float(scale), float(offset)) for scale, offset in info["noise_profile"])
    different = len(set(colors))
    return RawCapture(
        counts,
        pattern,
        colors,
        torch.tensor(header["black"], dtype=torch.float32),
        float(header["white"]),
        xyz_to_camera=_matrix([row[:3] for row in header["xyz_to_camera"][:different]]),
        camera_to_srgb=_matrix([row[:different] for row in header["camera_to_srgb"]]),
        white_balance=_balance(header["white_balance"], colors),
        daylight_balance=_balance(header["daylight_balance"], colors),
        flip=header["flip"] & 7,
        pixel_aspect=header["pixel_aspect"],
        info=RawInfo(**info),
    )


def _matrix(rows: list[list[float]]) -> Tensor | None:
    """Return a colour matrix, or None if the file has none, for which LibRaw returns zeros."""
    matrix = torch.tensor(rows)
    known = matrix.numel() and bool(matrix.isfinite().all() & (matrix != 0).any(0).all() & (matrix != 0).any(1).all())
    return matrix if known else None


def _balance(factors: list[float], colors: str) -> Tensor | None:
    """Return white balance factors scaled to 1 for the first green (else first) channel, or None if one is unknown."""
    known = [factors[i] or factors[colors.index(letter)] for i, letter in enumerate(colors)]
    first = known[max(colors.find("G"), 0)] if known else 0
    balance = torch.tensor(known) / first if first else torch.zeros(1)
    return balance if bool(balance.isfinite().all() & (balance > 0).all()) else None
