"""Decoder process: a raw file on standard input, a JSON header and the counts on standard output.

LibRaw is C++ code that parses untrusted files: a file can crash it, keep it busy or exhaust the memory. It runs in
this process with limits of time and memory, and the parent process reads a JSON header and plain numbers.
:mod:`kornia_tidy.lab.raw.decoding` runs this file by its path, so that only NumPy and rawpy are imported.
"""

from __future__ import annotations

import importlib
import io
import json
import os
import sys
import types
from typing import Any

LARGEST_TILE = 6  # X-Trans
LOADED = "loaded"  # printed once NumPy and LibRaw are imported: an earlier crash is not caused by the file
PACKAGE = "kornia_tidy_raw"  # name of this folder in the decoder process


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
    """Import a module of this folder, but not the package, which would take longer than decoding."""
    package = types.ModuleType(PACKAGE)
    package.__path__ = [os.path.dirname(os.path.abspath(__file__))]
    sys.modules.setdefault(PACKAGE, package)
    return importlib.import_module(f"{PACKAGE}.{name}")


def decode(data: bytes) -> tuple[dict[str, Any], memoryview]:
    """Decode a raw file into a header and counts of the visible area, by rows with channels last."""
    import numpy as np  # noqa: PLC0415 (after the limits)
    import rawpy  # noqa: PLC0415

    tags, dng_sensor, dng_samples, dng_levels = map(_beside, ("tags", "dng_sensor", "dng_samples", "dng_levels"))

    sys.stderr.write(LOADED + "\n")  # standard error is not buffered
    directories = list(tags.tiff_directories(data))
    if missing := dng_sensor.missing_bytes(data, directories):
        raise ValueError(f"it is cut short, {missing} bytes of its picture are missing")
    sensor, picture = dng_sensor.dng_sensor(data, directories), None
    if sensor is not None and not dng_samples.decoded_by_libraw(data, sensor):
        picture = dng_samples.read_samples(data, sensor)
    # Left open: the counts are LibRaw's own memory.
    raw = rawpy.imread(io.BytesIO(data if picture is None else dng_samples.plain_version(data, sensor)))
    counts = raw.raw_image_visible
    colors = raw.rgb_xyz_matrix.tolist(), raw.color_matrix.tolist()
    if not raw.color_matrix.any() and not raw.rgb_xyz_matrix.any():  # LibRaw does not return this tag
        colors = colors[0], tags.kodak_matrix(data) or colors[1]
    header = {
        "xyz_to_camera": colors[0],
        "camera_to_srgb": colors[1],
        "white_balance": raw.camera_whitebalance,
        "daylight_balance": raw.daylight_whitebalance,
        "flip": raw.sizes.flip if tags.orientation_known(directories) else 0,
        "pixel_aspect": raw.sizes.pixel_aspect,
        "info": {**tags.camera_tags(data), **libraw_info(raw)},
    }
    if sensor is not None and (picture is not None or (counts.ndim == 2) == (sensor.samples == 1)):
        header["info"]["ignored_opcodes"] = dng_sensor.ignored_opcodes(data, sensor)
        counts = dng_levels.described(header, counts if picture is None else picture, sensor, raw)
    else:
        counts = _described_by_libraw(header, counts, raw)
    counts = np.ascontiguousarray(counts)
    header |= {"shape": counts.shape if counts.ndim == 3 else (*counts.shape, 1), "type": counts.dtype.name}
    return header, counts.data.cast("B")


def _described_by_libraw(header: dict[str, Any], counts: Any, raw: Any) -> Any:
    """Write filter array and levels as LibRaw tells them into a header, and return the counts of its channels."""
    channels = 1 if counts.ndim == 2 else min(raw.num_colors, counts.shape[2])
    pattern = None if counts.ndim == 3 or raw.num_colors == 1 else filter_pattern(raw)
    colors, levels = raw.color_desc.decode("ascii", "replace"), raw.black_level_per_channel
    if pattern is None:
        colors, black = "" if channels == 1 else colors[:channels], levels[:channels]
    else:
        colors = colors[: 1 + max(map(max, pattern))]
        black = [[levels[c] for c in row] for row in pattern]
    header |= {"pattern": pattern, "colors": colors, "black": black, "white": raw.white_level}
    return counts if counts.ndim == 2 else counts[..., :channels]


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
