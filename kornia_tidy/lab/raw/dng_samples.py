"""Samples of a DNG that LibRaw does not decode right: floating-point, separate planes, Deflate, scattered strips.

LibRaw divides floating-point samples above 32767 or below 4096 by the brightest one to make counts of them, takes
separate planes for interleaved ones, and reads strips as if they followed one another. The decoder process runs this
file, so it imports only the standard library and NumPy.

Source: TIFF 6.0, sections 3, 14 and 15; Adobe Photoshop TIFF technical note 3 for floating-point prediction; DNG 1.4,
chapter 3, for 24-bit floating-point numbers and the predictors for several samples.
"""

from __future__ import annotations

import itertools
import struct
import zlib
from collections.abc import Iterator

import numpy as np

from . import tags
from .dng_sensor import LINEAR_RAW, LOSSY_JPEG, MAP_POLYNOMIAL, Sensor, opcodes

NO_COMPRESSION, JPEG = 1, 7
# Kind of difference and number of pixels between the two samples, by the value of Predictor.
PREDICTORS = {2: ("integer", 1), 34892: ("integer", 2), 34893: ("integer", 4)}
PREDICTORS |= {3: ("float", 1), 34894: ("float", 2), 34895: ("float", 4)}
UNUSED_TAG, ANYWHERE = 0xFFFE, 8  # of LibRaw's version of a file
HIGHEST = 65535  # of a sample
ROWS_AT_ONCE = 64  # packed bits take eight times the memory of the samples
HIGHEST_DEGREE = 8  # of LibRaw's polynomials


def decoded_by_libraw(data: bytes, sensor: Sensor) -> bool:
    """Return whether LibRaw decodes the samples of a DNG right.

    Raises:
        ValueError: if they are compressed in a way that neither LibRaw nor this module decodes.
    """
    directory = sensor.directory
    tiled = tags.TILES[0] in directory.entries
    if sensor.compression in {JPEG, LOSSY_JPEG}:
        name = "lossy JPEG" if sensor.compression == LOSSY_JPEG else "JPEG"
        if sensor.floating or sensor.separate:
            kind = "floating-point samples" if sensor.floating else "separate planes (PlanarConfiguration 2)"
            raise ValueError(f"its {kind} compressed by {name} cannot be decoded")
        strips = directory.long_values(data, tags.STRIPS[0])
        if not tiled and len(strips) > 1:
            raise ValueError(
                f"its {len(strips)} strips compressed by {name} cannot be decoded, only tiles or one strip"
            )
        wide = _first(sensor, tags.TILE_SIZE[0])
        if sensor.compression == LOSSY_JPEG:
            _check_lossy(data, sensor)
        elif tiled and wide > sensor.width:
            raise ValueError(f"its JPEG tiles of {wide} pixels are wider than its picture of {sensor.width}")
        return True
    if sensor.floating or sensor.separate or sensor.compression != NO_COMPRESSION or tiled:
        return False
    ends = ANYWHERE
    for number, (place, _, block) in enumerate(_blocks(data, sensor)):
        if number and place != ends:
            return False
        ends = place + block[0] * _row_bytes(sensor, block[1])
    if ends > len(data):
        raise ValueError(f"it is cut short, {ends - len(data)} bytes of its picture are missing")
    return True


def read_samples(data: bytes, sensor: Sensor) -> np.ndarray:
    """Return the stored samples, (height, width, samples), uint16 or float32, linearised by the table of the file.

    Raises:
        ValueError: if they are damaged, or stored in a way that is not decoded.
    """
    directory, planes = sensor.directory, sensor.samples if sensor.separate else 1
    kind, step = _predictor(sensor)
    picture = np.zeros((sensor.height, sensor.width, sensor.samples), np.float32 if sensor.floating else np.uint16)
    together = sensor.samples // planes
    for place, length, (rows, columns, plane, top, left) in _blocks(data, sensor):
        row = _row_bytes(sensor, columns)
        if columns % step:
            raise ValueError(f"its Predictor of every {step} pixels does not fit rows of {columns}")
        stored = data[place : place + (row * rows if sensor.compression == NO_COMPRESSION else length)]
        if sensor.compression != NO_COMPRESSION:
            stored = _inflated(stored, row * rows)
        if len(stored) < row * rows:
            raise ValueError(f"it is damaged or cut short: {row * rows - len(stored)} bytes of its samples are missing")
        block = np.frombuffer(stored, np.uint8, row * rows).reshape(rows, row)
        values = _values(block, sensor, columns * together, kind, step * together)
        there = picture[top : top + rows, left : left + columns, plane * together : (plane + 1) * together]
        there[:] = values.reshape(rows, columns, together)[: there.shape[0], : there.shape[1]]
    if tags.LINEARIZATION not in directory.entries:
        return picture
    values = directory.long_values(data, tags.LINEARIZATION)
    if sensor.floating or not values or not all(type(value) is int and 0 <= value <= HIGHEST for value in values):
        raise ValueError(f"its LinearizationTable of {len(values)} values is not one of 16 bits for integer samples")
    return np.array(values, np.uint16)[np.minimum(picture, len(values) - 1)]


def plain_version(data: bytes, sensor: Sensor) -> bytearray:
    """Return the file with tags of 16-bit samples in one strip, from which LibRaw reads colours and orientation.

    LibRaw opens a file only if it knows how to decode it, and decodes it before it tells the white balance.
    """
    plain, order = bytearray(data), sensor.directory.order
    plain += bytes(max(12, ANYWHERE + 2 * sensor.samples * sensor.width * sensor.height - len(plain)))
    strips = dict.fromkeys((tags.STRIPS[0], tags.TILES[0]), (tags.STRIPS[0], 4, ANYWHERE))
    one = {
        tags.COMPRESSION: (tags.COMPRESSION, 3, 1),
        tags.PLANAR: (tags.PLANAR, 3, 1),
        tags.SAMPLE_FORMAT: (tags.SAMPLE_FORMAT, 3, 1),
    }
    unused = dict.fromkeys(
        (tags.PREDICTOR, tags.LINEARIZATION, *tags.TILE_SIZE, tags.STRIPS[1], tags.TILES[1]), (UNUSED_TAG, 3, 1)
    )
    for tag, (new, kind, value) in {**strips, **one, **unused, tags.BITS: (tags.BITS, 3, 16)}.items():
        if tag in sensor.directory.entries:
            layout = "HHIHxx" if kind == 3 else "HHII"
            struct.pack_into(order + layout, plain, sensor.directory.entries[tag], new, kind, 1, value)
    return plain


def _check_lossy(data: bytes, sensor: Sensor) -> None:
    """Raise ``ValueError`` unless LibRaw linearises lossy JPEG as the file says.

    LibRaw applies the polynomial of each of three planes to the samples over 255, and nothing else.
    """
    found = [text for code, _, text in opcodes(data, sensor.directory, tags.OPCODE_LISTS[1]) if code == MAP_POLYNOMIAL]
    # area and planes: top, left, bottom, right, first plane, planes, row pitch, column pitch; then the degree
    shapes = [struct.unpack_from(">9I", text) for text in found if len(text) >= 36]
    known = (
        sensor.directory.whole_numbers(tags.PHOTOMETRIC)[:1] == (LINEAR_RAW,)
        and (sensor.samples, sensor.bits, sensor.area[:2]) == (3, 8, (0, 0))
        and set(sensor.white) == {255}
        and not any(level for row in sensor.black for pixel in row for level in pixel)
        and not any((*sensor.black_columns, *sensor.black_rows))
        and tags.LINEARIZATION not in sensor.directory.entries
        and sorted(shape[4:8] for shape in shapes) == [(plane, 1, 1, 1) for plane in range(3)]
        and all(shape[8] <= HIGHEST_DEGREE for shape in shapes)
    )
    if not known:
        raise ValueError(
            "its lossy JPEG is not of the kind that can be linearised: 8-bit red, green and blue, black 0, white 255, "
            "and one MapPolynomial for each"
        )


def _blocks(data: bytes, sensor: Sensor) -> Iterator[tuple[int, int, tuple[int, int, int, int, int]]]:
    """Yield the strips or tiles: offset and length in the file; rows, columns, plane, top and left."""
    directory = sensor.directory
    tiled, kept = tags.TILES[0] in directory.entries, sensor.samples if sensor.separate else 1
    if tiled:
        columns, rows = (_first(sensor, tag) for tag in tags.TILE_SIZE)
        if min(rows, columns) < 1:
            raise ValueError(f"its tiles have {columns} x {rows} pixels (TileWidth and TileLength)")
    else:
        rows = _first(sensor, tags.ROWS_PER_STRIP) or sensor.height
        rows, columns = min(rows, sensor.height), sensor.width
    offsets, lengths = (directory.long_values(data, tag) for tag in (tags.TILES if tiled else tags.STRIPS))
    if sensor.compression == NO_COMPRESSION:
        lengths = lengths or (0,) * len(offsets)  # not needed
    needed = kept * -(-sensor.height // rows) * -(-sensor.width // columns)
    if not len(offsets) == len(lengths) == needed or not all(type(n) is int for n in (*offsets, *lengths)):
        kind = "tiles" if tiled else "strips"
        raise ValueError(
            f"its picture takes {needed} {kind}, and it names {len(offsets)} places and {len(lengths)} sizes"
        )
    corners = itertools.product(range(kept), range(0, sensor.height, rows), range(0, sensor.width, columns))
    for offset, length, (plane, top, left) in zip(offsets, lengths, corners, strict=True):
        yield offset, length, (rows if tiled else min(rows, sensor.height - top), columns, plane, top, left)


def _first(sensor: Sensor, tag: int) -> int:
    return (sensor.directory.whole_numbers(tag) or (0,))[0]


def _row_bytes(sensor: Sensor, columns: int) -> int:
    return -(-columns * (1 if sensor.separate else sensor.samples) * sensor.bits // 8)


def _predictor(sensor: Sensor) -> tuple[str, int]:
    """Return the kind of differences that are stored, and the number of pixels between the two samples."""
    code = _first(sensor, tags.PREDICTOR)
    if code in {0, 1}:
        return "", 1
    kind, step = PREDICTORS.get(code, ("", 1))
    if kind != ("float" if sensor.floating else "integer") or sensor.bits % 8 or sensor.compression == NO_COMPRESSION:
        how = "uncompressed" if sensor.compression == NO_COMPRESSION else "floating-point" if sensor.floating else ""
        raise ValueError(
            f"its Predictor {code} does not belong to its {how or 'integer'} samples of {sensor.bits} bits"
        )
    return kind, step


def _inflated(stored: bytes, length: int) -> bytes:
    try:
        return zlib.decompressobj().decompress(stored, length)
    except zlib.error:
        raise ValueError("it is damaged: its Deflate data cannot be decompressed") from None


def _values(block: np.ndarray, sensor: Sensor, count: int, kind: str, step: int) -> np.ndarray:
    """Return the samples of rows of bytes, (rows, count); differences are to the sample ``step`` before."""
    order = sensor.directory.order
    size = sensor.bits // 8
    if kind == "float":
        # Differences between all bytes of a row, in which the first bytes of all samples come first, then the second.
        block = _summed(block, step).reshape(len(block), size, count)
        block, order = np.ascontiguousarray(block.transpose(0, 2, 1)).reshape(len(block), -1), ">"
    if sensor.floating and sensor.bits == 24:
        return _from_24_bits(block.reshape(len(block), count, 3), order)
    if sensor.bits in {8, 16, 32}:
        values = block.view(np.dtype(f"{order}{'f' if sensor.floating else 'u'}{size}"))
        return _summed(values.astype(values.dtype.newbyteorder("=")), step) if kind == "integer" else values
    values = np.empty((len(block), count), np.uint16)  # whole bytes or not, the highest bit is the first
    for top in range(0, len(block), ROWS_AT_ONCE):
        rows = block[top : top + ROWS_AT_ONCE]
        padded = np.zeros((len(rows), count, 16), np.uint8)
        padded[..., 16 - sensor.bits :] = np.unpackbits(rows, 1, count * sensor.bits).reshape(len(rows), count, -1)
        values[top : top + ROWS_AT_ONCE] = np.packbits(padded).view(">u2").reshape(len(rows), count)
    return values


def _summed(values: np.ndarray, step: int) -> np.ndarray:
    """Return sums over rows of differences to the value ``step`` before, modulo the range of the integers."""
    return np.cumsum(values.reshape(len(values), -1, step), 1, dtype=values.dtype).reshape(values.shape)


def _from_24_bits(block: np.ndarray, order: str) -> np.ndarray:
    """Return floating-point numbers of 24 bits (a sign, 7 of the exponent, 16 of the fraction) as float32.

    Example:
        >>> _from_24_bits(np.array([[0x7F, 0, 1], [0xC0, 0x80, 0]], np.uint8), ">")
        array([nan, -3.], dtype=float32)
    """
    high, middle, low = np.moveaxis(block if order == ">" else block[..., ::-1], -1, 0).astype(np.uint32)
    exponent, fraction = high & 127, middle << 8 | low
    bits = np.where(exponent == 127, 255, exponent + 64) << 23 | fraction << 7
    values = bits.astype(np.uint32).view(np.float32)
    tiny = fraction.astype(np.float32) * np.float32(2.0**-78)  # subnormal: the exponent is that of 1
    return np.copysign(np.where(exponent == 0, tiny, values), np.where(high & 128, np.float32(-1), np.float32(1)))
