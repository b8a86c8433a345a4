"""TIFF decoding: the numbers of the one picture or map in a file, and the meaning that the file gives them.

OpenCV's reader is not used: it gives back freed memory for separate planes, turns the picture by its orientation,
multiplies colours by alpha and packed values by powers of two, and takes a preview for the picture.

Source: TIFF 6.0, sections 4 to 8 and 18; GDAL's GeoTIFF driver (missing values, scale and mask); libtiff's
``checkcmap`` (colour maps of 8 bits).
"""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kornia_tidy.data.tiff_directories import DESCRIPTION, PHOTOMETRIC, Directory, picture_directories
from kornia_tidy.data.tiff_segments import JPEG, Layout, decode_segments, layout_of, named
from kornia_tidy.data.transfer import profile_is_linear
from kornia_tidy.optics.units import metres_in

ORIENTATION, COLOUR_MAP, EXTRA_SAMPLES, ICC_PROFILE, GDAL_METADATA, GDAL_NODATA = 274, 320, 338, 34675, 42112, 42113

_WHITE_IS_ZERO, _BLACK_IS_ZERO, _RGB, _PALETTE, _YCBCR = 0, 1, 2, 3, 6
_COLOURS = {_WHITE_IS_ZERO: 1, _BLACK_IS_ZERO: 1, _RGB: 3, _PALETTE: 1, _YCBCR: 3}  # samples without extra ones
_ASSOCIATED, _UNASSOCIATED = 1, 2  # kinds of alpha: colours are multiplied by the first
_UNSIGNED, _SIGNED, _FLOAT = 1, 2, 3  # SampleFormat
_SCALE = re.compile(rb"<Item [^<>]{0,200}role=[\"'](scale|offset|unittype)[\"'][^<>]{0,200}>([^<>]{1,40})</Item>")
_CALIBRATION = re.compile(rb"\n(cf|c\d|vunit)=([^\n]{1,40})")
_NOT_A_NUMBER = re.compile(r"[-+]?1\.#(QNAN|IND)0*")  # as older programs of Windows write it


def decode_tiff(
    data: bytes, depth: bool = False
) -> tuple[NDArray[Any], float | None, NDArray[np.bool_] | None, int, float, bool]:
    """Decode a TIFF.

    Args:
        data: bytes of the file.
        depth: whether depth is wanted and not a picture. Palettes and WhiteIsZero are refused then.

    Returns:
        values: (H, W, C) in the stored rows and columns, without alpha and other extra samples. WhiteIsZero is
            inverted, palette indices are replaced by colours, and JPEG's YCbCr is converted to RGB.
        white: the number that means 1 in a picture of integers.
        unknown: (H, W), True where the file says that nothing was measured: by GDAL's missing value, by a mask, by
            transparency or by a strip or tile that is left out. None if it says so nowhere.
        orientation: 1 to 8 as in EXIF.
        scale: factor for the numbers in GDAL's or ImageJ's metadata, with the metres in their unit; 1 without one.
        linear: whether its colour profile says that a picture is linear light.

    Raises:
        ValueError: if the file is damaged, of a kind that is not read, or holds several pictures or none.
    """
    directory, mask = picture_directories(data)
    layout = layout_of(directory)
    photometric = _photometric(directory, layout)
    if depth and photometric in {_WHITE_IS_ZERO, _PALETTE}:
        what = "0 is white" if photometric == _WHITE_IS_ZERO else "they are colours of a palette"
        raise ValueError(f"its numbers are no depth: {what} (photometric interpretation {photometric})")
    scale = _scale(directory) if depth else 1.0
    colours, alpha = _channels(directory, layout, photometric)
    missing = _missing_value(directory, layout.dtype)
    stored, absent = decode_segments(data, directory, layout, missing)
    values = stored[..., :colours]
    white = 1 if layout.format == _FLOAT else 2 ** (layout.bits - (layout.format == _SIGNED)) - 1
    if alpha == _ASSOCIATED and (stored[..., -1] != white).any():
        raise ValueError("its colours are multiplied by its alpha (ExtraSamples 1): save it without transparency")
    unknown = []
    if depth and colours == 1:
        unknown += [absent] if absent is not None else []
        unknown += [values[..., 0] == missing] if missing is not None else []
        unknown += [stored[..., -1] == 0] if alpha else []
        unknown += [decode_segments(data, mask, layout_of(mask))[0][..., 0] == 0] if mask is not None else []
    if photometric == _PALETTE:
        values = _palette(directory, layout)[values[..., 0]]
        white = np.iinfo(values.dtype).max
    elif photometric == _WHITE_IS_ZERO and layout.format != _SIGNED:
        values = white - values if layout.format == _FLOAT else values ^ values.dtype.type(white)
    orientation = directory.number(ORIENTATION, 1)
    return (
        values,
        white if layout.format == _UNSIGNED else None,
        np.logical_or.reduce(unknown) if unknown else None,
        orientation if 1 <= orientation <= 8 else 1,
        scale,
        not depth and profile_is_linear(directory.stored_bytes(ICC_PROFILE)),
    )


def _photometric(directory: Directory, layout: Layout) -> int:
    """Return the photometric interpretation; raise ``ValueError`` for unsupported ones."""
    photometric = directory.number(PHOTOMETRIC, _RGB if layout.samples > 2 else _BLACK_IS_ZERO)
    if photometric not in _COLOURS:
        name = f"photometric interpretation {photometric}, {named('PHOTOMETRIC', photometric)}"
        raise ValueError(f"the meaning of its pixels is not read ({name})")
    if photometric == _YCBCR and (layout.compression, layout.planes, layout.samples) != (JPEG, 1, 3):
        raise ValueError(
            "its pixels are YCbCr (photometric interpretation 6), which is read with JPEG in one plane only"
        )
    if photometric == _PALETTE and (layout.compression == JPEG or layout.format != _UNSIGNED or layout.bits > 16):
        raise ValueError(f"its pixels are indices of a palette, of {layout.bits} bits or with JPEG, which is not read")
    if _COLOURS[photometric] > layout.samples:
        raise ValueError(f"the file is damaged: it is RGB with {layout.samples} samples a pixel")
    return photometric


def _channels(directory: Directory, layout: Layout, photometric: int) -> tuple[int, int]:
    """Return the number of colour samples, and the kind of alpha behind them or 0.

    Three grey samples are R, G and B: GDAL calls them grey unless they are bytes.
    """
    extra = directory.numbers(EXTRA_SAMPLES)[: layout.samples].tolist()
    colours = _COLOURS[photometric]
    if photometric == _BLACK_IS_ZERO and layout.samples > 2 and not any(extra[:2]):
        colours, extra = 3, extra[2:]
    surplus = layout.samples - colours
    kind = extra[0] if extra else 0
    if surplus > 1 or (surplus == 1 and colours == 1 and kind not in {_ASSOCIATED, _UNASSOCIATED}):
        raise ValueError(
            f"it has {layout.samples} samples a pixel with photometric interpretation {photometric} and ExtraSamples "
            f"{', '.join(map(str, extra)) or 'missing'}: save the one that is meant in its own file"
        )
    return colours, kind if surplus and kind in {_ASSOCIATED, _UNASSOCIATED} else 0


def _missing_value(directory: Directory, dtype: np.dtype[Any]) -> Any:
    """Return GDAL's value for missing pixels; None without such a value, or where the data type cannot hold it."""
    if GDAL_NODATA not in directory:
        return None
    text = directory.text(GDAL_NODATA).decode("latin-1").strip()
    if not text:
        return None
    text = "nan" if _NOT_A_NUMBER.fullmatch(text) else text
    try:
        value = float(text)
        whole = int(text) if text.lstrip("+-").isdigit() else value  # beyond 2^53 too
    except ValueError:
        raise ValueError(f"its GDAL_NODATA is {text!r:.40}, which is no number") from None
    if dtype.kind == "f":
        with np.errstate(over="ignore"):
            return dtype.type(value)
    most = np.iinfo(dtype)
    return dtype.type(int(whole)) if most.min <= whole <= most.max and whole == int(whole) else None


def _scale(directory: Directory) -> float:
    """Return the metres in the numbers' unit by GDAL or ImageJ, 1 if they do not say it.

    Raises:
        ValueError: if they also give an offset or a curve, or a unit of inverse depth.
    """
    if directory.text(DESCRIPTION).startswith(b"ImageJ="):
        given, source = dict(_CALIBRATION.findall(directory.text(DESCRIPTION))), "calibration of ImageJ"
        changes = [given.get(name, default) for name, default in ((b"c1", b"1"), (b"c0", b"0"), (b"cf", b"0"))]
    else:
        given, source = dict(_SCALE.findall(directory.text(GDAL_METADATA))), "GDAL_METADATA"
        changes = [given.get(b"scale", b"1"), given.get(b"offset", b"0")]
    unit = given.get(b"unittype", given.get(b"vunit", b"")).decode("utf-8", "replace")
    try:
        scale, *others = (float(text) for text in changes)
    except ValueError:
        texts = b", ".join(changes).decode("latin-1")
        raise ValueError(f"the file is damaged: its {source} gives {texts:.100}, not numbers") from None
    if any(others) or not 0 < scale < math.inf:
        values = b", ".join(b"%s %s" % pair for pair in given.items()).decode("latin-1")
        raise ValueError(f"its numbers are to be changed by {values:.100} ({source}): save the depths themselves")
    return scale * metres_in(unit)


def _palette(directory: Directory, layout: Layout) -> NDArray[Any]:
    """Return the colours of a palette, (entries, 3): bytes where the upper ones of the file say all."""
    entries = directory.numbers(COLOUR_MAP)
    if len(entries) != 3 << layout.bits:
        raise ValueError(f"the file is damaged: its palette has {len(entries)} numbers, not {3 << layout.bits}")
    colours = entries.reshape(3, -1).T.astype(np.uint16)
    if (colours < 256).all():  # as some old programs write them
        return colours.astype(np.uint8)
    upper, lower = colours >> 8, colours & 0xFF
    return upper.astype(np.uint8) if not lower.any() or (lower == upper).all() else colours
