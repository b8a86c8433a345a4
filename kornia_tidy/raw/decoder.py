"""Decoder process: a raw file on standard input, a JSON header and the counts on standard output.

LibRaw is C++ code that parses untrusted files: a file can crash it, keep it busy or exhaust the memory. It runs in
this process with limits of time and memory, and the parent process reads a JSON header and plain numbers.
:mod:`kornia_tidy.raw.decoding` runs this file by its path, so that only NumPy and rawpy are imported.
"""

from __future__ import annotations

import importlib.machinery
import io
import json
import math
import os
import sys
import types
from typing import Any

LARGEST_TILE = 6  # X-Trans
LOADED = "loaded"  # printed once NumPy and LibRaw are imported: an earlier crash is not caused by the file
C330_LENGTHS = (2247168, 3370752)  # bytes; LibRaw recognises the headerless files of a Kodak C330 by their length


def main() -> None:
    """Decode standard input; arguments are the folders of NumPy and rawpy as JSON, and limits in seconds and bytes."""
    paths, seconds, memory = sys.argv[1:]
    limit(int(seconds), int(memory))
    sys.path += json.loads(paths)  # after the standard library
    with os.fdopen(os.dup(1), "wb") as output:
        os.dup2(2, 1)  # LibRaw prints to standard output too
        try:
            header, counts = decode(sys.stdin.buffer.read())
        except Exception as error:  # any error means that the file cannot be read
            header, counts = {"error": type(error).__name__, "text": _words(error)}, b""
        output.write(json.dumps(header).encode() + b"\n")
        output.write(counts)


def limit(seconds: int, memory: int) -> None:
    """Limit processor time and memory of this process and disable core files, where the system supports it."""
    try:
        import resource  # noqa: PLC0415 (not on Windows)
    except ImportError:
        return
    wanted = {resource.RLIMIT_CPU: seconds, resource.RLIMIT_AS: memory, resource.RLIMIT_CORE: 0}
    for kind, most in wanted.items():
        hard = resource.getrlimit(kind)[1]
        allowed = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(kind, (allowed, allowed))


def _beside(name: str) -> Any:
    """Import a module of this folder by its path, since importing the package would take longer than decoding."""
    path = os.path.join(os.path.dirname(os.path.abspath(__file__)), f"{name}.py")
    loader = importlib.machinery.SourceFileLoader(name, path)
    module = types.ModuleType(name)
    loader.exec_module(module)
    return module


def decode(data: bytes) -> tuple[dict[str, Any], memoryview]:
    """Decode a raw file into a header and uint16 counts of the visible area, by rows with channels last."""
    import numpy as np  # noqa: PLC0415 (after the limits)
    import rawpy  # noqa: PLC0415

    tags = _beside("tags")

    sys.stderr.write(LOADED + "\n")  # standard error is not buffered
    if missing := tags.missing_bytes(data):
        raise ValueError(f"it is cut short, {missing} bytes of its picture are missing")
    if fault := tags.filter_array_fault(data):
        raise ValueError(fault)
    raw = rawpy.imread(io.BytesIO(data))  # left open: the counts are LibRaw's own memory
    counts = np.ascontiguousarray(raw.raw_image_visible)
    sizes, levels = raw.sizes, raw.black_level_per_channel
    channels = 1 if counts.ndim == 2 else min(raw.num_colors, counts.shape[2])
    pattern = None if counts.ndim == 3 or raw.num_colors == 1 else filter_pattern(raw)
    colors = raw.color_desc.decode("ascii", "replace")
    if pattern is None:
        colors = "" if channels == 1 else colors[:channels]
        black = levels[:channels]
    else:
        colors = colors[: 1 + max(map(max, pattern))]
        black = [[levels[c] for c in row] for row in pattern]
        if (tile := tags.black_tile(data)) is not None:
            black = mean_over_tile(tile, len(pattern), len(pattern[0]))
    if counts.ndim == 3:
        counts = np.ascontiguousarray(counts[..., :channels])
    white = raw.white_level
    if counts.ndim == 3 and len(set(levels)) == 1 and white + levels[0] in tags.white_levels(data):
        white += levels[0]  # LibRaw subtracts a common black level from white but not from the counts
    camera_to_srgb = raw.color_matrix.tolist()
    if not raw.color_matrix.any() and not raw.rgb_xyz_matrix.any():  # LibRaw does not return this tag
        camera_to_srgb = tags.kodak_matrix(data) or camera_to_srgb
    header = {
        "shape": (*counts.shape[:2], channels),
        "pattern": pattern,
        "colors": colors,
        "black": black,
        "white": white,
        "xyz_to_camera": raw.rgb_xyz_matrix.tolist(),
        "camera_to_srgb": camera_to_srgb,
        "white_balance": raw.camera_whitebalance,
        "daylight_balance": raw.daylight_whitebalance,
        "flip": sizes.flip,
        "pixel_aspect": sizes.pixel_aspect,
        "info": {**tags.camera_tags(data), **libraw_info(raw)},
    }
    if counts.ndim == 3 and len(data) in C330_LENGTHS and not any(tags.tiff_directories(data)):
        header |= finished_colors()
    return header, counts.data.cast("B")


def finished_colors() -> dict[str, Any]:
    """Return header fields of a Kodak C330 file; its YCbCr data are white-balanced sRGB."""
    return {
        "camera_to_srgb": [[float(row == column) for column in range(4)] for row in range(3)],
        "white_balance": [1.0] * 4,
        "daylight_balance": [1.0] * 4,
        "info": {"make": "Kodak", "model": "C330"},
    }


def filter_pattern(raw: Any) -> list[list[int]]:
    """Return the smallest repeating tile of the filter array from the visible corner, as channel indices.

    The channel of each place is queried from LibRaw, whose own tile starts at the corner of the whole sensor with its
    margins.
    """
    top, left = raw.sizes.top_margin, raw.sizes.left_margin
    span = range(4 * LARGEST_TILE)
    places = [[raw.raw_color(top + row, left + column) for column in span] for row in span]
    for side in (2, LARGEST_TILE):
        tile = [row[:side] for row in places[:side]]
        if all(places[row][column] == tile[row % side][column % side] for row in span for column in span):
            return tile
    raise ValueError("its filter array repeats neither after 2 nor after 6 pixels")


def mean_over_tile(levels: list[list[float]], rows: int, columns: int) -> list[list[float]]:
    """Return black levels averaged onto the filter tile, from levels that repeat with another period."""
    tall, wide = math.lcm(len(levels), rows), math.lcm(len(levels[0]), columns)

    def mean(row: int, column: int) -> float:
        places = [
            levels[y % len(levels)][x % len(levels[0])]
            for y in range(row, tall, rows)
            for x in range(column, wide, columns)
        ]
        return sum(places) / len(places)

    return [[mean(row, column) for column in range(columns)] for row in range(rows)]


def libraw_info(raw: Any) -> dict[str, Any]:
    """Return LibRaw's exposure data by the field names of RawInfo; empty with older versions of rawpy."""
    try:
        other, lens = raw.other, raw.lens
    except (AttributeError, OSError, OverflowError, ValueError):  # for example an impossible timestamp
        return {}
    numbers = {
        "iso": other.iso_speed,
        "exposure": other.shutter_speed,
        "aperture": other.aperture,
        "focal_length": other.focal_length * 1e-3,
    }
    found: dict[str, Any] = {
        name: float(f"{value:.7g}")  # LibRaw's values are float32: 5.6 and not 5.599999904632568
        for name, value in numbers.items()
        if 0 < value < 1e9
    }
    if lens.model.strip() and lens.model.isprintable():
        found["lens"] = lens.model.strip()
    if other.timestamp.timestamp() > 0:
        found["timestamp"] = other.timestamp.isoformat()
    return found


def _words(error: Exception) -> str:
    """Return an error's message as text; LibRaw's messages are bytes."""
    cause = error.args[0] if error.args else ""
    return cause.decode("ascii", "replace") if isinstance(cause, bytes) else str(cause)


if __name__ == "__main__":
    main()
