"""Depth in OpenEXR files, as Blender and other renderers write it."""

from __future__ import annotations

import io
import math
import struct
import sys
import threading
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from typing import Any, NamedTuple, TextIO

import numpy as np
from numpy.typing import NDArray

from kornia_tidy.data.picture_header import check_pixels
from kornia_tidy.data.quiet import caught
from kornia_tidy.search_path import import_extra

MAGIC = b"v/1\x01"

_COLOURS = ("R", "G", "B")
_VECTORS = {"Z": "X", "V": "U"}  # a channel, and the one beside which it belongs to a vector
_NO_DEPTH = ("mist", "denoising")  # beginnings of the names of Blender's layers that have a channel Z too
_MOST_SHOWN = 300  # characters of channel names in a message
_MOST_EMPTY = 4096  # pixels without data for each one with data: a small file may not take a large memory
_MOST_UNFOLDED = 1 << 13  # values for each byte of a file; constant ones reach an eighth of it (DWAB)
_LARGE_TILE = 1 << 22  # pixels; they may be more than the picture has, and are decoded together
_MOST_TEXTS = 100  # of a header that are not UTF-8


class _Channel(NamedTuple):
    part: int
    layer: str
    leaf: str
    name: str


class _Window(NamedTuple):
    top: int
    left: int
    size: tuple[int, int]

    @classmethod
    def of(cls, corners: Any) -> _Window:
        """Return a window by its corners, which are the first and the last column and row."""
        (left, top), (right, bottom) = (map(int, corner) for corner in corners)
        if right < left or bottom < top:
            raise ValueError
        return cls(top, left, (bottom - top + 1, right - left + 1))


class _Header(NamedTuple):
    kind: Any
    compression: str
    data: _Window
    display: _Window
    tile: int
    channels: list[_Channel]


def decode_exr(data: bytes) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
    """Decode the depth in an OpenEXR file. It needs ``pip install 'kornia-tidy[exr]'``.

    A single channel is depth, unless it is alpha or mist. Of several, depth is the one that is named ``Z``, ``V`` or
    ``depth`` in any layer, or a grey layer with *depth* in its name. Coordinates of vectors (``X``, ``Y``, ``Z``;
    ``U``, ``V``) and Blender's mist and denoising data do not count. Without such a name, depth is red if red, green
    and blue are equal.

    Args:
        data: bytes of the file.

    Returns:
        The values (H, W) float16, float32 or uint32; and (H, W), True where the file has no data, or None.

    Raises:
        ImportError: if the package OpenEXR is missing.
        ValueError: if the file is damaged, deep or too large, or which of its channels is depth is not clear.

    Convention:
        Rows and columns are those of the display window. Data beyond it are dropped, and a pixel in it without data, as
        around a rendered region, is unknown.

    Source: OpenEXR, Technical introduction, and OpenEXR file layout; Blender's manual, Render passes.
    """
    library = _library()
    found = _parts(data, header_only=True)
    try:
        headers = [_header(number, part.header) for number, part in enumerate(found)]
    except (KeyError, TypeError, ValueError, AttributeError):
        raise ValueError("its OpenEXR header is damaged") from None
    if not all(header.kind in {library.scanlineimage, library.tiledimage} for header in headers):
        raise ValueError("it is a deep OpenEXR, with several depths a pixel, and flat ones are read")
    if any("J2K" in header.compression for header in headers):
        raise ValueError("its OpenEXR is compressed by JPEG 2000 (HTJ2K), which is not read")
    _check_sizes(headers, len(data))
    channels = [channel for header in headers for channel in header.channels]
    chosen, *equal = _depth_channels(channels)
    parts = _parts(data, header_only=False)
    if len(parts) != len(headers):
        raise ValueError("the file is cut short or damaged")
    values = _pixels(parts, chosen)
    if not all(np.array_equal(values, _pixels(parts, other), equal_nan=True) for other in equal):
        raise _unclear("its red, green and blue differ", channels)
    return _in_display(values, headers[chosen.part])


def _library() -> Any:
    return import_extra("OpenEXR", "an OpenEXR file")  # without type hints


def _parts(data: bytes, *, header_only: bool) -> list[Any]:
    """Return the intact parts of a file."""
    library = _library()
    for _ in range(_MOST_TEXTS):
        said = _Said()
        try:
            with caught(), redirect_stdout(said):  # messages of the library, and of its Python module
                file = library.File(io.BytesIO(data), separate_channels=True, header_only=header_only, num_threads=0)
                parts = list(file.parts)
        except MemoryError:
            raise
        except UnicodeDecodeError as error:  # a text in the header; other encodings are allowed
            before = struct.pack("<i", len(error.object)) + error.object
            data = data.replace(before, before[:4] + b"?" * len(error.object), 1)
            continue
        except Exception as error:  # the library raises many kinds
            raise ValueError(f"its OpenEXR is cut short or damaged: {' '.join(str(error).split()):.100}") from error
        if "MemoryError" in said.text:
            raise MemoryError
        return parts
    raise ValueError("its OpenEXR header is damaged: its texts are none")


class _Said(io.TextIOBase):
    """Standard output that keeps what this thread prints, and passes on what others print."""

    def __init__(self) -> None:
        self.text, self.thread, self.others = "", threading.get_ident(), sys.stdout

    text: str
    others: TextIO

    def write(self, text: str) -> int:
        """Keep or pass on a text."""
        if threading.get_ident() != self.thread:
            return self.others.write(text)
        self.text += text
        return len(text)


def _header(number: int, header: Mapping[str, Any]) -> _Header:
    """Return the values of a part's header; the part's name is the layer of channels that name none."""
    channels = []
    for channel in header["channels"]:
        layer, _, leaf = channel.name.rpartition(".")
        channels.append(_Channel(number, layer or str(header.get("name", "")), leaf, channel.name))
    tiles = header.get("tiles")
    return _Header(
        header["type"],
        str(header["compression"]),
        _Window.of(header["dataWindow"]),
        _Window.of(header["displayWindow"]),
        1 if tiles is None else tiles.xSize * tiles.ySize,
        channels,
    )


def _check_sizes(headers: Sequence[_Header], length: int) -> None:
    """Raise ``ValueError`` if the pixels of a file are too many, or more than its bytes can hold."""
    fours, values = 0, 0
    for header in headers:
        pixels, shown = math.prod(header.data.size), math.prod(header.display.size)
        check_pixels("the picture", *header.data.size)
        check_pixels("the picture", *header.display.size)
        if shown > _MOST_EMPTY * pixels:
            raise ValueError(
                f"its OpenEXR holds {header.data.size} pixels of a display window of {header.display.size}, too few"
            )
        fours += pixels * -(-len(header.channels) // 4)
        values += max(pixels, header.tile if header.tile > _LARGE_TILE else 0) * len(header.channels)
    check_pixels(f"the file, its {sum(len(header.channels) for header in headers)} channels by fours,", 1, fours)
    if values > _MOST_UNFOLDED * length:
        raise ValueError("the file is cut short: no compression makes its picture as small")


def _depth_channels(channels: Sequence[_Channel]) -> list[_Channel]:
    """Return the channel of depth, and those that must be equal to it.

    Raises:
        ValueError: if no channel fits, or several do.
    """
    if len(channels) == 1 and channels[0].leaf != "A" and not _last(channels[0].layer).startswith(_NO_DEPTH):
        return [*channels]
    layers: dict[tuple[int, str], dict[str, _Channel]] = {}
    for channel in channels:
        layers.setdefault((channel.part, channel.layer), {})[channel.leaf] = channel
    found = []
    for (_, layer), members in layers.items():
        name = _last(layer)
        if name.startswith(_NO_DEPTH):
            continue
        named = [
            channel
            for leaf, channel in members.items()
            if leaf.lower() == "depth" or (leaf in _VECTORS and _VECTORS[leaf] not in members)
        ]
        grey = [members[leaf] for leaf in _COLOURS if leaf in members]
        if named:
            found += [[channel] for channel in named]
        elif "depth" in name and (len(members) == 1 or len(grey) == 3):
            found.append(grey or [*members.values()])
    if not found and len(layers) == 1 and set(members) - {"A"} == set(_COLOURS):
        found.append(grey)
    if len(found) != 1:
        reason = f"it may be any of {_listed([channel for channel, *_ in found])}" if found else "none is named for it"
        raise _unclear(reason, channels)
    return found[0]


def _last(layer: str) -> str:
    """Return the last part of a layer's name, in lower case."""
    return layer.rpartition(".")[2].lower()


def _unclear(reason: str, channels: Sequence[_Channel]) -> ValueError:
    """Return the error for a file with an ambiguous depth."""
    return ValueError(
        f"which channel of its OpenEXR is depth is not clear, {reason}: of {_listed(channels)} write only one to a file"
    )


def _listed(channels: Sequence[_Channel]) -> str:
    names = ", ".join(channel.name for channel in channels) or "no channels"
    return names if len(names) <= _MOST_SHOWN else f"{names[:_MOST_SHOWN]}..."


def _pixels(parts: Sequence[Any], channel: _Channel) -> NDArray[Any]:
    found = parts[channel.part].channels.get(channel.name)
    if found is None or not isinstance(found.pixels, np.ndarray):
        raise ValueError("the file is cut short or damaged")
    if (found.xSampling, found.ySampling) != (1, 1):
        raise ValueError(
            f"its channel {channel.name:.40} has one sample for {found.xSampling} x {found.ySampling} pixels"
        )
    return found.pixels


def _in_display(values: NDArray[Any], header: _Header) -> tuple[NDArray[Any], NDArray[np.bool_] | None]:
    """Return the pixels of the display window, and those of them without data."""
    size = header.display.size
    if values.shape != header.data.size:
        raise ValueError("the file is cut short or damaged")
    top, left = header.data.top - header.display.top, header.data.left - header.display.left
    if (top, left) == (0, 0) and size == values.shape:
        return values, None
    placed, unknown = np.zeros(size, values.dtype), np.ones(size, np.bool_)
    part = values[max(0, -top) :, max(0, -left) :][: max(0, size[0] - max(0, top)), : max(0, size[1] - max(0, left))]
    here = np.s_[max(0, top) : max(0, top) + part.shape[0], max(0, left) : max(0, left) + part.shape[1]]
    placed[here], unknown[here] = part, False
    return placed, unknown
